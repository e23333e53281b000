"""`saga-fg demo`: simulated traffic, three trackers, a table, a picture and a page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.console import progress_bar
from pipelines.cli.options import Config, Scenario, Verbose
from pipelines.cli.summary import counted
from pipelines.cli.tables import show_tables

READING = """\
MOTA counts missed objects, false boxes and identity switches. kf and saga go on reporting hidden objects, centerpoint
does not. A hidden object without a box is no miss, but a box farther than 2 m from all objects is false, so a method
that predicts hidden objects badly loses MOTA."""


def demo(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the picture and the page.")] = Path(
        "saga-fg-demo"
    ),
    scenes: Annotated[int, typer.Option("--scenes", min=1, help="Number of simulated scenes.")] = 3,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the simulation.")] = 0,
    scenario: Annotated[
        Scenario,
        typer.Option("--scenario", help="What the scenes are about; those with a map by the heterogeneous settings."),
    ] = "traffic",
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """Simulate traffic, track it with three methods, and compare them.

    Prints a table, and writes a bird's-eye picture and an HTML page with a player. Takes less than a minute.

    \b
    Examples:
      saga-fg demo
      saga-fg demo --output out --scenes 1 --seed 3
      saga-fg demo --output out --scenario road-works --scenes 1
    """
    from data_tools.simulator.scenarios import scenario_settings
    from pipelines.config import load_config
    from pipelines.demo import run_demo
    from pipelines.demo.comparison import comparison_table

    with progress_bar() as progress:
        family = "simulated" if scenario in ("traffic", "two-sensors") else "heterogeneous"
        settings = load_config(family, config)
        result = run_demo(output, settings, scenario_settings(scenario), scenes, seed, progress)
    title = f"{counted(scenes, 'simulated scene')}, seed {seed}"
    show_tables([comparison_table(result.comparison, title)])
    typer.echo(READING)
    typer.echo(f"picture: {result.picture}\npage:    {result.page}")

"""`python -m benchmarks fusion`: what a second sensor is worth."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console
from rich.table import Table

from pipelines.cli.options import Config, Verbose
from pipelines.cli.reporting import progress_bar
from pipelines.cli.tables import JsonFile


def fusion(
    scenes: Annotated[int, typer.Option("--scenes", min=2, help="Simulated scenes to compare on.")] = 20,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the first of them.")] = 0,
    gap: Annotated[float, typer.Option("--gap", min=0.1, help="How long the better sensor is silent, s.")] = 3.0,
    method: Annotated[Literal["saga", "kf"], typer.Option("--method", help="Tracking method.")] = "saga",
    simulator: Annotated[
        Path | None, typer.Option("--simulator", help="YAML file; see `saga-fg config --simulator`.", metavar="FILE")
    ] = None,
    json_file: JsonFile = None,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """Each sensor alone, both, both with a gap in the better one, and both with a poor third one.

    \b
    Examples:
      python -m benchmarks fusion
      python -m benchmarks fusion --scenes 4 --method kf --json figures.json
    """
    from benchmarks.fusion import fusion as run
    from data_tools.figures import write_figures
    from data_tools.files.atomic_files import check_writable
    from data_tools.simulator import SimulatorSettings
    from pipelines.config import load_config
    from pipelines.configuration import load_settings

    if json_file is not None:
        check_writable(json_file)
    world = load_settings(SimulatorSettings, simulator) if simulator is not None else SimulatorSettings()
    settings = load_config("simulated", config)
    with progress_bar(unit="scenes") as progress:
        result = run(settings, range(seed, seed + scenes), gap, method, world, progress)
    table = Table("sensors", "AMOTA", title=f"{scenes} simulated scenes", title_justify="left")
    for name, value in result.amota.items():
        table.add_row(name, f"{value:.4f}")
    Console().print(table)
    for name, change in (
        (f"both against {result.better} alone", result.gain),
        ("a poor sensor more", result.poor_loss),
    ):
        typer.echo(
            f"AMOTA, {name}: {100 * change.estimate:+.2f} points "
            f"({100 * change.confidence:.0f} % interval {100 * change.low:+.2f} to {100 * change.high:+.2f})"
        )
    typer.echo(
        f"{result.better} silent for {gap:g} s; of {result.followed} objects that stay in the other's view, kept:"
    )
    for name, share in result.survival.items():
        typer.echo(f"  {name}: {100 * share:.1f} %")
    if json_file is not None:
        write_figures(json_file, asdict(result))

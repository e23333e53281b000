"""`python -m benchmarks heterogeneous`: what lights, lanes, cones and couplings are worth in the graph."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, cast

import typer

from data_tools.datasets.source import names
from pipelines.cli.options import Config, Verbose
from pipelines.cli.reporting import progress_bar
from pipelines.cli.tables import JsonFile, show_tables

KINDS = "red-light,road-works,towing,cycling"


def heterogeneous(
    kinds: Annotated[str, typer.Option("--kinds", help="Kinds of scenes, with commas between them.")] = KINDS,
    scenes: Annotated[int, typer.Option("--scenes", min=2, help="Simulated scenes of each kind.")] = 8,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the first of them.")] = 0,
    duration: Annotated[float, typer.Option("--duration", min=5.0, help="Length of a scene, s.")] = 12.0,
    json_file: JsonFile = None,
    markdown: Annotated[
        Path | None, typer.Option("--markdown", help="Write the tables to this file too.", metavar="FILE")
    ] = None,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """Predict two seconds ahead with the full graph, with cars alone, and without edges.

    Scenes hold a red light with a map, cones that close a lane, trucks with trailers, or riders on bicycles. The file
    of --config changes the shipped settings, `saga-fg config --for heterogeneous`.

    \b
    Examples:
      python -m benchmarks heterogeneous
      python -m benchmarks heterogeneous --kinds red-light --scenes 20 --seed 100 --json figures.json
    """
    from benchmarks.heterogeneous import heterogeneous as run
    from benchmarks.heterogeneous import tables
    from data_tools.figures import write_figures
    from data_tools.files.atomic_files import check_writable, write_text
    from data_tools.simulator.scenarios import SCENARIOS, ScenarioName
    from pipelines.config import load_config
    from saga_fg.errors import InputError

    chosen = names("--kinds", kinds)
    for kind in chosen:
        if kind not in SCENARIOS:
            raise InputError(f"--kinds: expected some of {', '.join(SCENARIOS)}, got {kind!r}")
    for path in (json_file, markdown):
        if path is not None:
            check_writable(path)
    seeds = range(seed, seed + scenes)
    with progress_bar(unit="scenes") as progress:
        results = run(load_config("heterogeneous", config), cast(list[ScenarioName], chosen), seeds, duration, progress)
    found = tables(results)
    show_tables(found)
    if json_file is not None:
        write_figures(json_file, results)
    if markdown is not None:
        write_text(markdown, "\n".join(table.markdown() for table in found))

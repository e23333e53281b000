"""`python -m benchmarks scaling`: node-only filtering against node and edge states."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.options import Verbose, counts
from pipelines.cli.reporting import progress_bar
from pipelines.cli.tables import JsonFile, show_tables


def scaling(
    objects: Annotated[
        str, typer.Option("--objects", help="Numbers of objects, with commas between.")
    ] = "5,10,20,50,100,200",
    joint_limit: Annotated[
        int, typer.Option("--joint-limit", min=2, help="Most objects for one filter over all nodes and edges.")
    ] = 20,
    frames: Annotated[int, typer.Option("--frames", min=30, help="Length of a recording.")] = 140,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the drawn recordings.")] = 0,
    json_file: JsonFile = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Draw the figures to this PNG.", metavar="PNG")
    ] = None,
    verbose: Verbose = False,
) -> None:
    """What estimating edges as well as nodes costs, and what it brings: cost and accuracy over the number of objects.

    \b
    Examples:
      python -m benchmarks scaling
      python -m benchmarks scaling --objects 5,10,15 --frames 60 --json figures.json --output scaling.png
    """
    from benchmarks.scaling import ScalingSettings, bench_scaling, write_picture
    from data_tools.figures import FigureTable, cell, write_figures
    from data_tools.files.atomic_files import check_writable

    sizes = counts("--objects", objects, least=2)  # one has no neighbours
    for path in (json_file, output):
        if path is not None:
            check_writable(path)
    settings = ScalingSettings(sizes, joint_limit, frames, seed=seed)
    with progress_bar(unit="sizes") as progress:
        rows = bench_scaling(settings, progress)
    columns = ("objects", "filter", "numbers", "ms a frame", "/ nodes", "RMSE hidden, m", "RMSE, m", "off by, sigma")
    shown = tuple(
        (
            str(row.nodes),
            row.contender,
            str(row.states),
            cell(row.milliseconds, 2),
            cell(row.ratio, 2),
            cell(row.hidden_rmse),
            cell(row.rmse),
            f"{row.largest_difference:.1e}",
        )
        for row in rows
    )
    show_tables([FigureTable("nodes alone, and nodes and edges", columns, shown)])
    if json_file is not None:
        write_figures(json_file, {"settings": asdict(settings), "rows": [asdict(row) for row in rows]})
    if output is not None:
        write_picture(output, rows)

"""`python -m benchmarks association`: what each way of matching costs."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from pipelines.cli.options import Verbose, counts
from pipelines.cli.reporting import progress_bar
from pipelines.cli.tables import JsonFile, show_tables


def association(
    objects: Annotated[str, typer.Option("--objects", help="Numbers of objects, with commas between.")] = "50,100,200",
    seconds: Annotated[float, typer.Option("--seconds", min=1.0, help="Length of a scene.")] = 10.0,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the drawn scenes.")] = 0,
    json_file: JsonFile = None,
    verbose: Verbose = False,
) -> None:
    """What matching detections to tracks costs: Hungarian, greedy, and the graph's, on the same drawn scenes.

    \b
    Examples:
      python -m benchmarks association
      python -m benchmarks association --objects 200 --seconds 4 --json figures.json
    """
    from benchmarks.association import bench_association
    from data_tools.figures import FigureTable, cell, write_figures
    from data_tools.files.atomic_files import check_writable

    sizes = counts("--objects", objects)
    if json_file is not None:
        check_writable(json_file)
    with progress_bar(unit="sizes") as progress:
        rows = bench_association(sizes, seconds, seed, progress)
    columns = ("objects", "method", "ms a frame", "/ hungarian", "whole tracker, ms", "ID switches")
    cells = [
        (str(r.objects), r.method, cell(r.milliseconds, 2), cell(r.ratio, 2), cell(r.whole_milliseconds, 2))
        for r in rows
    ]
    shown = tuple((*cells[k], str(row.switches)) for k, row in enumerate(rows))
    show_tables([FigureTable("matching, groups of five drawn from the model", columns, shown)])
    if json_file is not None:
        write_figures(json_file, {"rows": [asdict(row) for row in rows]})

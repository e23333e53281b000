"""The bounded filter against the exact one."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from pipelines.cli.options import Verbose


def bounded(
    nodes: Annotated[int, typer.Option("--nodes", min=10, help="Nodes of one connected graph.")] = 1000,
    frames: Annotated[int, typer.Option("--frames", min=1, help="Frames that are counted.")] = 10,
    mixing: Annotated[float, typer.Option("--mixing", help="Share of velocity taken over in a frame.")] = 0.35,
    verbose: Verbose = False,
) -> None:
    """The bounded filter against the exact one: time, error and consistency for bounds of 1, 2 and 3 hops.

    \b
    Example:
      python -m benchmarks bounded --nodes 300 --frames 5
    """
    from benchmarks.bounded import BoundedBenchSettings, bench_bounded

    table = Table(title=f"bounded filter, {nodes} connected nodes", title_justify="left")
    for column in ("hops", "ms", "time / exact", "mean error, sigma", "worst, sigma", "ANEES / exact"):
        table.add_column(column, justify="right")
    for row in bench_bounded(BoundedBenchSettings(nodes=nodes, frames=frames, mixing=mixing)):
        figures = (row.milliseconds, row.ratio, row.mean_error, row.worst_error, row.anees_ratio)
        table.add_row(str(row.hops), *(f"{x:.3g}" for x in figures))
    Console().print(table)

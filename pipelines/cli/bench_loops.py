"""`saga-fg bench loops`: false loop closures in pose graphs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.console import progress_bar
from pipelines.cli.options import Verbose
from pipelines.cli.tables import JsonFile, report


def loops(
    files: Annotated[list[Path], typer.Argument(help="Pose graphs in the g2o format.")],
    shares: Annotated[str, typer.Option("--shares", help="False loops for each true one, with commas.")] = "0.1,0.3,1",
    seeds: Annotated[int, typer.Option("--seeds", min=1, help="Graphs made for each share.")] = 5,
    gnc: Annotated[bool, typer.Option("--gnc/--no-gnc", help="Run gtsam.GncLMOptimizer too.")] = True,
    json_file: JsonFile = None,
    verbose: Verbose = False,
) -> None:
    """Add false loops to pose graphs, and compare with the optimum without them.

    \b
    Example:
      saga-fg bench loops data/slam/CSAIL.g2o data/slam/intel.g2o
    """
    import numpy as np

    from data_tools.figures import FigureTable, cell
    from data_tools.files.error_messages import error_context
    from data_tools.pose_graphs import read_g2o, with_false_loops
    from pipelines.bench.loops import LoopsRow, bench_loops
    from saga_fg.errors import InputError

    try:
        wanted = [float(share) for share in shares.split(",")]
    except ValueError as error:
        raise InputError(f"--shares: expected numbers with commas, got {shares!r:.40}") from error
    if not all(0 <= share < np.inf for share in wanted):
        raise InputError(f"--shares: expected numbers >= 0 with commas, got {shares!r:.40}")
    graphs = [read_g2o(file) for file in files]
    for file, graph in zip(files, graphs, strict=True):
        with error_context(str(file)):
            with_false_loops(graph, 0.0, seed=0)  # refuses what cannot have any, before hours of others
    rows: list[LoopsRow] = []
    with progress_bar() as progress:
        for file, graph in zip(files, graphs, strict=True):
            with error_context(str(file)):
                rows += bench_loops(file.stem, graph, wanted, seeds, gnc, progress)
    shown = []
    for key in dict.fromkeys((row.graph, row.share, row.contender) for row in rows):
        group = [row for row in rows if (row.graph, row.share, row.contender) == key]
        off = [row.off for row in group]
        counts = (sum(row.lost for row in group), sum(row.taken for row in group))
        seconds = float(np.mean([row.seconds for row in group]))
        shown.append(
            (
                f"{key[0]}, {key[1]:g}",
                key[2],
                cell(float(np.median(off))),
                cell(max(off)),
                *map(str, counts),
                cell(seconds, 1),
            )
        )
    columns = ("graph, share", "method", "RMS off, m: median", "largest", "true lost", "false taken", "s")
    report([FigureTable("false loops: distance from the optimum without them", columns, tuple(shown))], rows, json_file)

"""`saga-fg bench slam`: LiDAR odometry beside KISS-ICP."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.console import progress_bar
from pipelines.cli.options import Verbose
from pipelines.cli.tables import JsonFile, report


def slam(
    dataroot: Annotated[Path, typer.Option("--dataroot", help="KITTI tracking: training/, or oxts/ and velodyne/.")],
    sequence: Annotated[str, typer.Option("--sequence", help="A sequence with LiDAR scans.")] = "0000",
    scans: Annotated[int | None, typer.Option("--scans", min=2, help="Only so many, from the first on.")] = None,
    kiss: Annotated[
        bool, typer.Option("--kiss/--no-kiss", help="With KISS-ICP, of the extra bench, or ours alone.")
    ] = True,
    open3d: Annotated[
        bool, typer.Option("--open3d", help="Our odometry with Open3D's registration in place of ours, too.")
    ] = False,
    json_file: JsonFile = None,
    verbose: Verbose = False,
) -> None:
    """LiDAR odometry against KISS-ICP, on the same scans in turn.

    RPE is the error over 10 m against GPS/IMU, which is itself not exact; the residual of scans in the map of their
    neighbours needs no reference. Both are printed for the scans as recorded and for de-skewed ones.

    \b
    Example:
      saga-fg bench slam --dataroot data/kitti --sequence 0000
    """
    from data_tools.datasets.kitti import KittiScans
    from data_tools.figures import FigureTable, cell
    from pipelines.bench.slam import OURS, bench_slam

    with progress_bar() as progress:
        rows = bench_slam(KittiScans(dataroot, sequence, most=scans), kiss, progress=progress, open3d=open3d)
    shown = []
    for row in rows:
        e = row.errors
        errors = (e.relative_translation, 57.29578 * e.relative_rotation, e.end_error, 1e3 * row.residual)
        shown.append((row.case, row.contender, *(cell(x) for x in errors), cell(row.milliseconds, 1)))
    columns = ("scans", "method", "RPE, m per 10 m", "RPE, deg per 10 m", "end, m", "residual, mm", "ms a scan")
    table = FigureTable(f"sequence {sequence}: odometry against GPS/IMU", columns, tuple(shown))
    report([table], rows, json_file)
    for ours, theirs in itertools.product(rows, rows):
        if ours.case == theirs.case and ours.contender == OURS != theirs.contender:
            worse = 100 * (ours.errors.relative_translation - theirs.errors.relative_translation)
            duller = 100 * (ours.residual / theirs.residual - 1)
            share = ours.milliseconds / theirs.milliseconds
            typer.echo(
                f"{ours.case}: RPE {worse:+.1f} cm per 10 m, residual {duller:+.1f} %, "
                f"time {share:.2f} of {theirs.contender}'s"
            )

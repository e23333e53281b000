"""`python -m benchmarks lidar`: LiDAR geometry on real scans."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from pipelines.cli.options import Verbose
from pipelines.cli.reporting import progress_bar
from saga_fg.errors import InputError

if TYPE_CHECKING:
    from benchmarks.lidar import BoxScores


def lidar(
    dataroot: Annotated[Path, typer.Option("--dataroot", help="KITTI tracking: training/, or oxts/ and velodyne/.")],
    sequence: Annotated[str, typer.Option("--sequence", help="A sequence with LiDAR scans.")] = "0000",
    reach: Annotated[float, typer.Option("--reach", help="Labelled cars within this distance count, m.")] = 30.0,
    scans: Annotated[int | None, typer.Option("--scans", min=2, help="Only so many, from the first on.")] = None,
    verbose: Verbose = False,
) -> None:
    """What the geometry functions find in each scan and cost, and recall and precision of boxes without a detector.

    The boxes are clusters of points; the graph tracker follows them. Labels cover the camera's image, so boxes outside
    of it do not count.

    \b
    Example:
      python -m benchmarks lidar --dataroot data/kitti --sequence 0000
    """
    from benchmarks.lidar import bench_lidar

    if not reach > 0:
        raise InputError(f"--reach {reach:g}: expected a distance > 0 m")
    with progress_bar(unit="scans") as progress:
        result = bench_lidar(dataroot, sequence, reach, scans, progress)
    table = Table("function", "found a scan", "ms a scan", title=f"sequence {sequence}", title_justify="left")
    for row in result.geometry:
        table.add_row(row.name, f"{row.found:.1f}", f"{row.milliseconds:.1f}")
    Console().print(table)
    typer.echo(f"cars within {reach:g} m: {result.clusters.labels} labels of {result.objects} vehicles")
    typer.echo(f"clusters: {_scores(result.clusters)}")
    typer.echo(f"tracks of the clusters: {_scores(result.tracks)}, {result.tracks.identities} identities")


def _scores(scores: BoxScores) -> str:
    return f"recall {scores.recall:.3f}, precision {scores.precision:.3f}, median error {scores.error:.2f} m"

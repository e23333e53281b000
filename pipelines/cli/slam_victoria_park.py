"""`saga-fg slam victoria-park`: landmarks of unknown identity."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.console import progress_bar
from pipelines.cli.options import Verbose
from pipelines.cli.summary import counted
from saga_fg.errors import InputError


def victoria_park(
    file: Annotated[Path, typer.Argument(help="Odometry and observations of trees, as distributed with GTSAM.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")],
    odometry_scale: Annotated[
        float | None,
        typer.Option(
            "--odometry-scale", help="Factor on the covariance of the odometry; chosen from data if not given."
        ),
    ] = None,
    verbose: Verbose = False,
) -> None:
    """Map trees, telling them apart without the identities in the file, and compare with these.

    Writes the trajectory (TUM, KITTI), the trees with their covariances (JSON, PLY), figures.json and a picture.

    \b
    Example:
      saga-fg slam victoria-park victoria_park.txt --output park
    """
    import numpy as np

    from data_tools.datasets.victoria_park import read_victoria_park
    from data_tools.files.atomic_files import check_writable_folder
    from data_tools.metrics.pairwise_agreement import pairwise_agreement
    from pipelines.slam.results import landmark_rows, planar_trajectory, write_landmark_map
    from pipelines.slam.victoria_park import ParkSettings, map_park

    if odometry_scale is not None and not 0 < odometry_scale < np.inf:
        raise InputError(f"--odometry-scale {odometry_scale:g}: expected a number > 0")
    settings = ParkSettings() if odometry_scale is None else ParkSettings(odometry_scales=(odometry_scale,))
    check_writable_folder(output)
    drive = read_victoria_park(file)
    with progress_bar(unit="poses") as progress:
        park = map_park(drive, settings, progress)
    agreement = pairwise_agreement([s.landmark for s in park.map.observations], drive.tree)
    named = len(np.unique(drive.tree))
    figures = {
        "poses": len(park.map.world_T_pose),
        "observations": len(drive.tree),
        "landmarks": len(park.map.landmarks),
        "landmarks named in the file": named,
        "pairwise precision": agreement.precision,
        "pairwise recall": agreement.recall,
        "pairwise F1": agreement.f1,
        "odometry scale": park.odometry_scale,
        "log evidence by odometry scale": {f"{scale:g}": value for scale, value in park.log_evidence.items()},
    }
    poses = planar_trajectory(np.arange(len(park.map.world_T_pose), dtype=np.float64), park.map.world_T_pose)
    write_landmark_map(output, poses, landmark_rows(park.map.landmarks), figures)
    typer.echo(
        f"{output}: {counted(len(poses), 'pose')}, {counted(len(drive.tree), 'observation')}, "
        f"{counted(len(park.map.landmarks), 'landmark')} ({named} in the file)"
    )
    typer.echo(
        f"association against the file: precision {agreement.precision:.4f}, recall {agreement.recall:.4f}, "
        f"F1 {agreement.f1:.4f}; odometry covariance x {park.odometry_scale:g}"
    )

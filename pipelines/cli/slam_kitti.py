"""`saga-fg slam kitti`: trajectory, map and landmarks of a KITTI sequence from its LiDAR scans."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from pipelines.cli.options import Verbose
from pipelines.cli.reporting import progress_bar
from pipelines.cli.summary import counted


def kitti(
    dataroot: Annotated[Path, typer.Option("--dataroot", help="KITTI tracking: training/, or oxts/ and velodyne/.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")],
    sequence: Annotated[str, typer.Option("--sequence", help="A sequence with LiDAR scans.")] = "0000",
    odometry: Annotated[
        Literal["lidar", "oxts"],
        typer.Option("--odometry", help="Motion between scans: by registration, or the recording's GPS/IMU."),
    ] = "lidar",
    deskew: Annotated[
        bool, typer.Option("--deskew/--no-deskew", help="Take the motion within a turn out of the scans.")
    ] = True,
    landmarks: Annotated[
        bool, typer.Option("--landmarks/--no-landmarks", help="Walls and poles as nodes of the graph.")
    ] = True,
    scans: Annotated[int | None, typer.Option("--scans", min=2, help="Only so many, from the first on.")] = None,
    verbose: Verbose = False,
) -> None:
    """LiDAR SLAM on a KITTI sequence: poses, walls and poles in one graph.

    Writes the trajectory (KITTI and TUM formats), covariances.csv, the map and the landmarks (map.ply, landmarks.ply,
    landmarks.json), a picture from above (above.png) and the errors against GPS/IMU (metrics.json).

    \b
    Examples:
      saga-fg slam kitti --dataroot data/kitti --sequence 0000 --output slam
      saga-fg slam kitti --dataroot data/kitti --odometry oxts --no-landmarks --output slam
    """
    from data_tools.atomic_files import atomic_directory
    from data_tools.kitti import KittiScans
    from pipelines.slam.kitti import write_lidar_slam
    from pipelines.slam.lidar_slam import LidarSlamSettings, lidar_slam

    recorded = KittiScans(dataroot, sequence, timed=deskew, most=scans)
    if not output.exists():
        with atomic_directory(output):
            pass  # a folder that cannot be written is said before the work, not after it
        output.rmdir()
    with progress_bar() as progress:
        result = lidar_slam(recorded, odometry, LidarSlamSettings(landmarks=landmarks), progress)
    figures = write_lidar_slam(output, result, recorded)
    counts = [counted(len(recorded), "scan"), counted(figures["keyframes"], "keyframe")]
    counts += [counted(number, name) for name, number in figures["landmarks"].items()]
    typer.echo(f"{output}: {', '.join([*counts, counted(figures['loops'], 'loop')])}")
    for name in ("odometry", "online", "trajectory"):
        e = figures[name]
        typer.echo(
            f"{name} against GPS/IMU: ATE {e['ate']:.3f} m, RPE {e['relative_translation']:.3f} m and "
            f"{57.29578 * e['relative_rotation']:.3f} deg per {e['relative_distance']:g} m, end {e['end_error']:.3f} m"
        )
    typer.echo(f"mean scan-to-map residual: {1e3 * figures['scan_to_map_residual']:.1f} mm")

"""`saga-fg track`: detections in, tracks out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.options import Config, Verbose, apart, chosen_scenes, names, sensor_files
from pipelines.cli.reporting import progress_bar
from pipelines.cli.summary import Summary
from pipelines.cli.tracking_options import EstimatorOption, LagOption, MethodOption, configured

track_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None)


@track_app.callback()
def track() -> None:
    """Track recorded detections: nuScenes, KITTI tracking, or files of your own."""


@track_app.command()
def nuscenes(
    dataroot: Annotated[Path, typer.Option("--dataroot", help="Folder that holds the folder of tables.")],
    detections: Annotated[
        list[str],
        typer.Option("--detections", help="Detection-result JSON of a sensor; repeatable.", metavar="NAME=FILE"),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Tracking-result JSON to write.")],
    version: Annotated[str, typer.Option("--version", help="Name of the folder of tables.")] = "v1.0-mini",
    split: Annotated[
        str | None, typer.Option("--split", help="An official split, or one of splits.json beside the tables.")
    ] = None,
    scenes: Annotated[str | None, typer.Option("--scenes", help="Scene names with commas between them.")] = None,
    method: MethodOption = "saga",
    estimator: EstimatorOption = None,
    lag: LagOption = None,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """Track nuScenes detections; writes the official tracking-result JSON.

    Detections are official detection-result JSON, one file a sensor.

    \b
    Examples:
      saga-fg track nuscenes --dataroot data/nuscenes --version v1.0-mini \\
          --detections lidar=megvii.json --split mini_train --output tracks.json
      saga-fg track nuscenes --dataroot data/nuscenes --scenes scene-0103 \\
          --detections lidar=a.json --detections camera=b.json \\
          --method kf --output tracks.json
      saga-fg track nuscenes --dataroot data/nuscenes --scenes scene-0103 \\
          --detections lidar=a.json --estimator fixed-lag --lag 3 --output tracks.json
    """
    from data_tools.nuscenes import NuScenes, write_tracking_results
    from pipelines.tracking import track_dataset

    chosen = chosen_scenes(dataroot, version, split, scenes)
    settings = configured("nuscenes", config, method, estimator, lag)
    files = sensor_files(detections)
    apart(output, *files.values())
    dataset = NuScenes(dataroot, version, files, chosen)
    summary = Summary(output)
    with progress_bar(len(chosen)) as progress:
        runs = summary.of(track_dataset(dataset, lambda: settings.new_tracker(method), progress=progress))
        write_tracking_results(output, ((run.scene, run.tracks) for run in runs), dataset.meta)
    summary.show()


@track_app.command()
def kitti(
    dataroot: Annotated[Path, typer.Option("--dataroot", help="Folder that holds training/, or oxts/ and calib/.")],
    detections: Annotated[
        Path, typer.Option("--detections", help="Folder with Car/, Pedestrian/, Cyclist/ and in each NNNN.txt.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write NNNN.txt to.")],
    sequences: Annotated[
        str | None, typer.Option("--sequences", help="Sequences with commas between them; all if left out.")
    ] = None,
    method: MethodOption = "saga",
    estimator: EstimatorOption = None,
    lag: LagOption = None,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """Track KITTI detections; writes the official result text, one file a sequence.

    \b
    Example:
      saga-fg track kitti --dataroot data/kitti --detections data/kitti/detections/pointrcnn \\
          --sequences 0000,0011 --output results
    """
    from data_tools.kitti import KittiTracking, write_kitti_results
    from pipelines.tracking import track_dataset

    settings = configured("kitti", config, method, estimator, lag)
    dataset = KittiTracking(dataroot, detections, names("--sequences", sequences) if sequences is not None else None)
    summary = Summary(output)
    with progress_bar(len(dataset.scenes)) as progress:
        runs = summary.of(track_dataset(dataset, lambda: settings.new_tracker(method), progress=progress))
        write_kitti_results(output, dataset, ((run.scene, run.tracks) for run in runs))
    summary.show()


@track_app.command()
def file(
    detections: Annotated[Path, typer.Argument(help="Table of detections: .csv, .ndjson, .jsonl or .npz.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Table of tracks to write: .csv, .ndjson or .jsonl.")],
    scenes: Annotated[
        str | None, typer.Option("--scenes", help="Scene names with commas between them; all if left out.")
    ] = None,
    method: MethodOption = "saga",
    estimator: EstimatorOption = None,
    lag: LagOption = None,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """Track your own detections: a table with one detection a row.

    The columns timestamp (s), x and y (m) are needed; label, score, sensor, size, heading and more are used where they
    are there (see docs/formats.md).

    \b
    Examples:
      saga-fg track file detections.csv --output tracks.csv
      saga-fg track file detections.ndjson --method kf --config mine.yaml --output tracks.ndjson
    """
    from data_tools.detection_files import read_detections, write_tracks
    from pipelines.tracking import track_dataset

    settings = configured("file", config, method, estimator, lag)
    apart(output, detections)
    dataset = read_detections(detections)
    chosen = dataset.scenes if scenes is None else names("--scenes", scenes)
    summary = Summary(output)
    with progress_bar(len(chosen)) as progress:
        runs = summary.of(track_dataset(dataset, lambda: settings.new_tracker(method), chosen, progress))
        write_tracks(output, ((run.scene, run.tracks) for run in runs))
    summary.show()

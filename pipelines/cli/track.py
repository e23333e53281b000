"""`saga-fg track`: detections in, tracks out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from pipelines.cli import options
from pipelines.cli import tracking_options as how
from pipelines.cli.reporting import progress_bar
from pipelines.cli.scaling import Detections, RayAddress, Workers, at_scale, only, run_at_scale, several
from pipelines.cli.summary import Summary

track_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None)


@track_app.callback()
def track() -> None:
    """Track recorded detections: nuScenes, KITTI tracking, or files of your own."""


@track_app.command()
def nuscenes(
    dataroot: Annotated[str, typer.Option("--dataroot", help="Folder that holds the folder of tables, or its URL.")],
    detections: options.SensorDetections,
    output: Annotated[Path, typer.Option("--output", "-o", help="Tracking-result JSON to write.")],
    version: options.Version = "v1.0-mini",
    split: options.Split = None,
    scenes: options.SceneNames = None,
    method: how.MethodOption = "saga",
    estimator: how.EstimatorOption = None,
    lag: how.LagOption = None,
    association: how.AssociationOption = None,
    interactions: how.InteractionsOption = None,
    explain: how.ExplainOption = False,
    workers: Workers = None,
    ray: RayAddress = None,
    config: options.Config = None,
    verbose: options.Verbose = False,
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
      saga-fg track nuscenes --dataroot data/nuscenes --version v1.0-trainval --split val \\
          --detections lidar=a.json --workers 0 --output run   # all cores; writes run/tracks.json
    """
    from data_tools.datasets.nuscenes import NuScenes, local_nuscenes, merge_tracking_results, write_tracking_results
    from data_tools.files.remote_files import is_url
    from pipelines.explaining import trackers
    from pipelines.scale_out import HeldScene, TrackTask
    from pipelines.tracking import track_dataset

    settings = how.configured("nuscenes", config, method, estimator, lag, association, interactions)
    locations = options.sensor_locations(detections)
    options.apart(output, *(Path(location) for location in locations.values() if not is_url(location)))
    with local_nuscenes(dataroot, version, locations) as (root, files):
        chosen = options.chosen_scenes(root, version, split, scenes)
        dataset = NuScenes(root, version, files, chosen)
        kept = how.journal(explain, output, at_scale(workers, ray))
        if at_scale(workers, ray):
            task = TrackTask(settings, method, "nuscenes", dataset.meta)
            inputs = (HeldScene(dataset.scene(name)) for name in chosen)

            def merge() -> None:
                merge_tracking_results(merged, (output / task.result(name) for name in chosen), dataset.meta)

            merged = output / "tracks.json"
            merged.unlink(missing_ok=True)
            run_at_scale(inputs, len(chosen), task, output, workers, ray, merge)
            return
        summary = Summary(output)
        with progress_bar(len(chosen)) as progress, trackers(settings, method, chosen, kept) as new_tracker:
            runs = summary.of(track_dataset(dataset, new_tracker, progress=progress))
            write_tracking_results(output, ((run.scene, run.tracks) for run in runs), dataset.meta)
        summary.write_record(method, settings)
        summary.show()


@track_app.command()
def kitti(
    dataroot: options.KittiRoot,
    detections: options.KittiDetections,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write NNNN.txt to.")],
    sequences: options.Sequences = None,
    method: how.MethodOption = "saga",
    estimator: how.EstimatorOption = None,
    lag: how.LagOption = None,
    association: how.AssociationOption = None,
    interactions: how.InteractionsOption = None,
    explain: how.ExplainOption = False,
    workers: Workers = None,
    ray: RayAddress = None,
    config: options.Config = None,
    verbose: options.Verbose = False,
) -> None:
    """Track KITTI detections; writes the official result text, one file a sequence.

    \b
    Example:
      saga-fg track kitti --dataroot data/kitti --detections data/kitti/detections/pointrcnn \\
          --sequences 0000,0011 --output results
    """
    from data_tools.datasets.kitti import local_kitti, write_kitti_results
    from pipelines.explaining import trackers
    from pipelines.scale_out import KittiInput, TrackTask
    from pipelines.tracking import track_dataset

    settings = how.configured("kitti", config, method, estimator, lag, association, interactions)
    chosen = options.names("--sequences", sequences) if sequences is not None else None
    with local_kitti(dataroot, detections, chosen) as dataset:
        kept = how.journal(explain, output, at_scale(workers, ray))
        if at_scale(workers, ray):
            sequence_inputs = (KittiInput(dataroot, detections, name) for name in dataset.scenes)
            task = TrackTask(settings, method, "kitti")
            run_at_scale(sequence_inputs, len(dataset.scenes), task, output, workers, ray)
            return
        summary = Summary(output)
        with (
            progress_bar(len(dataset.scenes)) as progress,
            trackers(settings, method, dataset.scenes, kept) as new_tracker,
        ):
            runs = summary.of(track_dataset(dataset, new_tracker, progress=progress))
            write_kitti_results(output, dataset, ((run.scene, run.tracks) for run in runs))
        summary.write_record(method, settings)
        summary.show()


@track_app.command()
def file(
    detections: Detections,
    output: Annotated[Path, typer.Option("--output", "-o", help="Table of tracks to write: .csv, .ndjson or .jsonl.")],
    scenes: options.ScenesOfFile = None,
    method: how.MethodOption = "saga",
    estimator: how.EstimatorOption = None,
    lag: how.LagOption = None,
    association: how.AssociationOption = None,
    interactions: how.InteractionsOption = None,
    explain: how.ExplainOption = False,
    workers: Workers = None,
    ray: RayAddress = None,
    table: Annotated[
        Literal["csv", "ndjson"], typer.Option("--table", help="Format of the tables, with --workers or --ray.")
    ] = "csv",
    config: options.Config = None,
    verbose: options.Verbose = False,
) -> None:
    """Track your own detections: a table with one detection a row.

    The columns timestamp (s), x and y (m) are needed; label, score, sensor, size, heading and more are used where they
    are there (see docs/formats.md).

    \b
    Examples:
      saga-fg track file detections.csv --output tracks.csv
      saga-fg track file detections.ndjson --method kf --config mine.yaml --output tracks.ndjson
      saga-fg track file 's3://fleet/2026-11/*.csv' --workers 0 --output run   # writes run/tracks/NAME.csv
    """
    from data_tools.datasets.detection_files import read_detections, write_tracks
    from data_tools.files.remote_files import local_copy
    from pipelines.explaining import trackers
    from pipelines.scale_out import DetectionFileInput, TrackTask
    from pipelines.tracking import track_dataset

    settings = how.configured("file", config, method, estimator, lag, association, interactions)
    kept = how.journal(explain, output, at_scale(workers, ray))
    if at_scale(workers, ray):
        urls = several(detections, scenes)
        task = TrackTask(settings, method, ".csv" if table == "csv" else ".ndjson")
        run_at_scale(map(DetectionFileInput, urls), len(urls), task, output, workers, ray)
        return
    with local_copy(only(detections)) as path:
        options.apart(output, path)
        dataset = read_detections(path)
    chosen = dataset.scenes if scenes is None else options.names("--scenes", scenes)
    summary = Summary(output)
    with progress_bar(len(chosen)) as progress, trackers(settings, method, chosen, kept) as new_tracker:
        runs = summary.of(track_dataset(dataset, new_tracker, chosen, progress))
        write_tracks(output, ((run.scene, run.tracks) for run in runs))
    summary.write_record(method, settings)
    summary.show()

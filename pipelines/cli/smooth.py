"""`saga-fg smooth`: recordings in, labels out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from pipelines.cli import options
from pipelines.cli import tracking_options as how
from pipelines.cli.reporting import ReportingGroup, progress_bar
from pipelines.cli.scaling import Detections, RayAddress, Workers, at_scale, only, run_at_scale, several
from pipelines.cli.summary import counted

if TYPE_CHECKING:
    from pipelines.config import Family
    from pipelines.smoothing import SmoothConfig, SmoothedScene, StreamedScene
    from saga_fg.tracking import AssociationName

smooth_app = typer.Typer(cls=ReportingGroup, no_args_is_help=True, rich_markup_mode=None)

Output = Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")]
TableSuffix = Annotated[
    Literal["csv", "ndjson", "parquet"],
    typer.Option("--table", help="Format of the table of boxes; parquet needs the extra [parquet]."),
]


@smooth_app.callback()
def smooth() -> None:
    """Make labels of recorded detections: past and future of every object, gaps filled, uncertainty stated."""


@smooth_app.command()
def nuscenes(
    dataroot: Annotated[str, typer.Option("--dataroot", help="Folder that holds the folder of tables, or its URL.")],
    detections: options.SensorDetections,
    output: Output,
    version: options.Version = "v1.0-mini",
    split: options.Split = None,
    scenes: options.SceneNames = None,
    method: how.MethodOption = "saga",
    association: how.AssociationOption = None,
    interactions: how.InteractionsOption = None,
    table: TableSuffix = "csv",
    workers: Workers = None,
    ray: RayAddress = None,
    config: options.Config = None,
    verbose: options.Verbose = False,
) -> None:
    """Label nuScenes recordings: tracking-result JSON, annotation tables, a table of boxes, a summary.

    \b
    Example:
      saga-fg smooth nuscenes --dataroot data/nuscenes --version v1.0-mini --split mini_train \\
          --detections lidar=megvii.json --output labels
      saga-fg smooth nuscenes --dataroot data/nuscenes --version v1.0-trainval --split train \\
          --detections lidar=megvii.json --workers 0 --output labels   # all cores
    """
    from data_tools.datasets.label_table import merge_label_parts
    from data_tools.datasets.nuscenes import NuScenes, local_nuscenes, merge_tracking_results
    from pipelines.scale_out import HeldScene, SmoothTask
    from pipelines.smoothing import smooth_dataset, write_nuscenes_run

    settings = _configured("nuscenes", config, method, association, interactions)
    with local_nuscenes(dataroot, version, options.sensor_locations(detections)) as (root, files):
        chosen = options.chosen_scenes(root, version, split, scenes)
        dataset = NuScenes(root, version, files, chosen)
        if at_scale(workers, ray):
            task = SmoothTask(settings, method, "nuscenes", f".{table}", dataset.meta)
            inputs = (HeldScene(dataset.scene(name)) for name in chosen)

            def merge() -> None:
                merge_tracking_results(tracking, (output / task.tracking(name) for name in chosen), dataset.meta)
                merge_label_parts(output, root, version, (output / task.objects(name) for name in chosen))

            tracking = output / "tracking.json"
            tracking.unlink(missing_ok=True)
            run_at_scale(inputs, len(chosen), task, output, workers, ray, merge)
            return
        with progress_bar(len(chosen)) as progress:
            runs = smooth_dataset(dataset, settings, method, chosen, progress)
            done = write_nuscenes_run(output, runs, root, version, dataset.meta, f".{table}")
        _show(output, done)


@smooth_app.command()
def kitti(
    dataroot: options.KittiRoot,
    detections: options.KittiDetections,
    output: Output,
    sequences: options.Sequences = None,
    method: how.MethodOption = "saga",
    association: how.AssociationOption = None,
    interactions: how.InteractionsOption = None,
    table: TableSuffix = "csv",
    workers: Workers = None,
    ray: RayAddress = None,
    config: options.Config = None,
    verbose: options.Verbose = False,
) -> None:
    """Label KITTI sequences: label_02 text, results with scores, a table of boxes, a summary.

    \b
    Example:
      saga-fg smooth kitti --dataroot data/kitti --detections data/kitti/detections/pointrcnn \\
          --sequences 0000,0011 --output labels
    """
    from data_tools.datasets.kitti import local_kitti
    from pipelines.scale_out import KittiInput, SmoothTask
    from pipelines.smoothing import smooth_dataset, write_kitti_run

    settings = _configured("kitti", config, method, association, interactions)
    chosen = options.names("--sequences", sequences) if sequences is not None else None
    with local_kitti(dataroot, detections, chosen) as dataset:
        if at_scale(workers, ray):
            inputs = (KittiInput(dataroot, detections, name) for name in dataset.scenes)
            task = SmoothTask(settings, method, "kitti", f".{table}")
            run_at_scale(inputs, len(dataset.scenes), task, output, workers, ray)
            return
        with progress_bar(len(dataset.scenes)) as progress:
            runs = smooth_dataset(dataset, settings, method, progress=progress)
            done = write_kitti_run(output, runs, dataset, f".{table}")
        _show(output, done)


@smooth_app.command()
def simulated(
    output: Output,
    scenes: Annotated[int, typer.Option("--scenes", min=1, help="Number of scenes.")] = 4,
    seed: Annotated[int, typer.Option("--seed", min=0, help="The same seed makes the same scenes.")] = 0,
    simulator: options.Simulator = None,
    method: how.MethodOption = "saga",
    association: how.AssociationOption = None,
    interactions: how.InteractionsOption = None,
    table: TableSuffix = "csv",
    workers: Workers = None,
    ray: RayAddress = None,
    config: options.Config = None,
    verbose: options.Verbose = False,
) -> None:
    """Label simulated traffic, whose truth is known: a table of boxes, a summary.

    \b
    Example:
      saga-fg smooth simulated --scenes 2 --seed 0 --output labels
      saga-fg smooth simulated --scenes 200 --workers 2 --output labels
    """
    from data_tools.simulator import SimulatedTraffic, SimulatorSettings
    from pipelines.configuration import load_settings
    from pipelines.scale_out import SimulatedInput, SmoothTask
    from pipelines.smoothing import smooth_dataset, write_labels

    settings = _configured("simulated", config, method, association, interactions)
    traffic = load_settings(SimulatorSettings, simulator) if simulator is not None else SimulatorSettings()
    dataset = SimulatedTraffic(traffic, scenes, seed)
    if at_scale(workers, ray):
        inputs = (SimulatedInput(traffic, scenes, seed, name) for name in dataset.scenes)
        run_at_scale(inputs, scenes, SmoothTask(settings, method, "table", f".{table}"), output, workers, ray)
        return
    with progress_bar(scenes) as progress:
        done = write_labels(output, smooth_dataset(dataset, settings, method, progress=progress), f".{table}")
    _show(output, done)


@smooth_app.command()
def file(
    detections: Detections,
    output: Output,
    scenes: options.ScenesOfFile = None,
    method: how.MethodOption = "saga",
    association: how.AssociationOption = None,
    interactions: how.InteractionsOption = None,
    table: TableSuffix = "csv",
    workers: Workers = None,
    ray: RayAddress = None,
    config: options.Config = None,
    verbose: options.Verbose = False,
) -> None:
    """Label your own recordings: a table with one detection a row in, one box a row out.

    The columns are those of `saga-fg track file` (see docs/formats.md). A recording is smoothed as it is read: memory
    does not grow with its length.

    \b
    Example:
      saga-fg smooth file detections.csv --output labels
      saga-fg smooth file 's3://fleet/2026-11/*.csv' --workers 0 --output labels
    """
    from data_tools.datasets.detection_files import read_scenes_in_parts
    from data_tools.files.remote_files import local_copy
    from pipelines.scale_out import DetectionFileInput, SmoothTask
    from pipelines.smoothing import smooth_stream, write_streamed_labels

    settings = _configured("file", config, method, association, interactions)
    if at_scale(workers, ray):
        urls = several(detections, scenes)
        task = SmoothTask(settings, method, "table", f".{table}")
        run_at_scale(map(DetectionFileInput, urls), len(urls), task, output, workers, ray)
        return
    chosen = None if scenes is None else options.names("--scenes", scenes)
    with local_copy(only(detections)) as path, progress_bar() as progress:
        parts = read_scenes_in_parts(path, scenes=chosen)
        done = write_streamed_labels(
            output, lambda folder: smooth_stream(parts, settings, folder, method, progress=progress), f".{table}"
        )
    _show(output, done)


def _show(output: Path, runs: tuple[SmoothedScene, ...] | tuple[StreamedScene, ...]) -> None:
    """The line that says what was done."""
    from saga_fg.smoothing import LabelCounts

    total = LabelCounts.sum(run.counts for run in runs)
    typer.echo(
        f"{output}: {counted(len(runs), 'scene')}, {counted(total.objects, 'object')}, {counted(total.boxes, 'box')}: "
        f"{total.observed} observed, {total.filled} filled, {total.extended} extended; "
        f"{total.dropped} dropped with {counted(total.dropped_objects, 'object')}; "
        f"{counted(total.joined, 'tracklet')} joined to others"
    )


def _configured(
    family: Family,
    config: Path | None,
    method: str,
    association: AssociationName | None,
    interactions: Path | None,
) -> SmoothConfig:
    """The settings of a run: the family's, the file's, then the options'."""
    from pipelines.smoothing import load_smooth_config

    how.association_fits(method, association)
    settings = load_smooth_config(family, config)
    tracking = how.with_interactions(settings.tracking, method, interactions)
    return replace(settings, tracking=tracking.with_association(association))

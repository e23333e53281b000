"""`saga-fg smooth`: recordings in, labels out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from pipelines.cli.options import Config, Verbose, chosen_scenes, names, sensor_files
from pipelines.cli.reporting import ReportingGroup, progress_bar
from pipelines.cli.summary import counted
from pipelines.cli.tracking_options import MethodOption

if TYPE_CHECKING:
    from pipelines.smoothing import SmoothedScene

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
    dataroot: Annotated[Path, typer.Option("--dataroot", help="Folder that holds the folder of tables.")],
    detections: Annotated[
        list[str],
        typer.Option("--detections", help="Detection-result JSON of a sensor; repeatable.", metavar="NAME=FILE"),
    ],
    output: Output,
    version: Annotated[str, typer.Option("--version", help="Name of the folder of tables.")] = "v1.0-mini",
    split: Annotated[
        str | None, typer.Option("--split", help="An official split, or one of splits.json beside the tables.")
    ] = None,
    scenes: Annotated[str | None, typer.Option("--scenes", help="Scene names with commas between them.")] = None,
    method: MethodOption = "saga",
    table: TableSuffix = "csv",
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """Label nuScenes recordings: tracking-result JSON, annotation tables, a table of boxes, a summary.

    \b
    Example:
      saga-fg smooth nuscenes --dataroot data/nuscenes --version v1.0-mini --split mini_train \\
          --detections lidar=megvii.json --output labels
    """
    from data_tools.nuscenes import NuScenes
    from pipelines.smoothing import load_smooth_config, smooth_dataset, write_nuscenes_run

    settings = load_smooth_config("nuscenes", config)
    chosen = chosen_scenes(dataroot, version, split, scenes)
    dataset = NuScenes(dataroot, version, sensor_files(detections), chosen)
    with progress_bar(len(chosen)) as progress:
        runs = smooth_dataset(dataset, settings, method, chosen, progress)
        done = write_nuscenes_run(output, runs, dataroot, version, dataset.meta, f".{table}")
    _show(output, done)


@smooth_app.command()
def kitti(
    dataroot: Annotated[Path, typer.Option("--dataroot", help="Folder that holds training/, or oxts/ and calib/.")],
    detections: Annotated[
        Path, typer.Option("--detections", help="Folder with Car/, Pedestrian/, Cyclist/ and in each NNNN.txt.")
    ],
    output: Output,
    sequences: Annotated[
        str | None, typer.Option("--sequences", help="Sequences with commas between them; all if left out.")
    ] = None,
    method: MethodOption = "saga",
    table: TableSuffix = "csv",
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """Label KITTI sequences: label_02 text, results with scores, a table of boxes, a summary.

    \b
    Example:
      saga-fg smooth kitti --dataroot data/kitti --detections data/kitti/detections/pointrcnn \\
          --sequences 0000,0011 --output labels
    """
    from data_tools.kitti import KittiTracking
    from pipelines.smoothing import load_smooth_config, smooth_dataset, write_kitti_run

    settings = load_smooth_config("kitti", config)
    dataset = KittiTracking(dataroot, detections, names("--sequences", sequences) if sequences is not None else None)
    with progress_bar(len(dataset.scenes)) as progress:
        runs = smooth_dataset(dataset, settings, method, progress=progress)
        done = write_kitti_run(output, runs, dataset, f".{table}")
    _show(output, done)


@smooth_app.command()
def simulated(
    output: Output,
    scenes: Annotated[int, typer.Option("--scenes", min=1, help="Number of scenes.")] = 4,
    seed: Annotated[int, typer.Option("--seed", min=0, help="The same seed makes the same scenes.")] = 0,
    simulator: Annotated[
        Path | None,
        typer.Option("--simulator", help="YAML file; see `saga-fg config --simulator`.", metavar="FILE"),
    ] = None,
    method: MethodOption = "saga",
    table: TableSuffix = "csv",
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """Label simulated traffic, whose truth is known: a table of boxes, a summary.

    \b
    Example:
      saga-fg smooth simulated --scenes 2 --seed 0 --output labels
    """
    from data_tools.simulator import SimulatedTraffic, SimulatorSettings
    from pipelines.configuration import load_settings
    from pipelines.smoothing import load_smooth_config, smooth_dataset, write_labels

    settings = load_smooth_config("simulated", config)
    traffic = load_settings(SimulatorSettings, simulator) if simulator is not None else SimulatorSettings()
    dataset = SimulatedTraffic(traffic, scenes, seed)
    with progress_bar(scenes) as progress:
        done = write_labels(output, smooth_dataset(dataset, settings, method, progress=progress), f".{table}")
    _show(output, done)


@smooth_app.command()
def file(
    detections: Annotated[Path, typer.Argument(help="Table of detections: .csv, .ndjson, .jsonl or .npz.")],
    output: Output,
    scenes: Annotated[
        str | None, typer.Option("--scenes", help="Scene names with commas between them; all if left out.")
    ] = None,
    method: MethodOption = "saga",
    table: TableSuffix = "csv",
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """Label your own recordings: a table with one detection a row in, one box a row out.

    The columns are those of `saga-fg track file` (see docs/formats.md).

    \b
    Example:
      saga-fg smooth file detections.csv --output labels
    """
    from data_tools.detection_files import read_detections
    from pipelines.smoothing import load_smooth_config, smooth_dataset, write_labels

    settings = load_smooth_config("file", config)
    dataset = read_detections(detections)
    chosen = dataset.scenes if scenes is None else names("--scenes", scenes)
    with progress_bar(len(chosen)) as progress:
        done = write_labels(output, smooth_dataset(dataset, settings, method, chosen, progress), f".{table}")
    _show(output, done)


def _show(output: Path, runs: tuple[SmoothedScene, ...]) -> None:
    """The line that says what was done."""
    from saga_fg.smoothing import LabelCounts

    total = LabelCounts.sum(run.counts for run in runs)
    typer.echo(
        f"{output}: {counted(len(runs), 'scene')}, {counted(total.objects, 'object')}, {counted(total.boxes, 'box')}: "
        f"{total.observed} observed, {total.filled} filled, {total.extended} extended; "
        f"{total.dropped} dropped with {counted(total.dropped_objects, 'object')}; "
        f"{counted(total.joined, 'tracklet')} joined to others"
    )

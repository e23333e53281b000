"""What a run of smoothing leaves: a folder of labels.

labels.csv       a row per box (or .ndjson, .parquet)
summary.json     how many boxes of each scene were observed, filled, extended and dropped
tracking.json    nuScenes: the official tracking result
VERSION/         nuScenes: tables whose annotations are the labels
label_02/        KITTI: text as of ground truth
results/         KITTI: the same with scores, as evaluators take it
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory

from data_tools.datasets.kitti import KittiTracking, write_kitti_results
from data_tools.datasets.nuscenes import ResultMeta, write_tracking_results
from data_tools.export.labels import write_kitti_labels, write_label_table, write_nuscenes_labels
from data_tools.files.atomic_files import atomic_directory
from pipelines.figures import write_figures
from pipelines.smoothing.scene import SmoothedScene
from pipelines.smoothing.streaming import StreamedScene
from saga_fg.smoothing import LabelCounts


def write_labels(
    directory: str | Path, runs: Iterable[SmoothedScene], suffix: str = ".csv"
) -> tuple[SmoothedScene, ...]:
    """Write the table of boxes and the summary; the folder is checked before the first run is asked for."""
    with atomic_directory(directory) as folder:
        done = tuple(runs)
        _write_common(folder, done, suffix)
    return done


def write_streamed_labels(
    directory: str | Path, smooth: Callable[[Path], Iterable[StreamedScene]], suffix: str = ".csv"
) -> tuple[StreamedScene, ...]:
    """The same of recordings that are smoothed as they are read; `smooth` is called with a folder for their spools."""
    with atomic_directory(directory) as folder, TemporaryDirectory(dir=folder) as spools:
        done = tuple(smooth(Path(spools)))
        write_label_table(folder / f"labels{suffix}", chain.from_iterable(run.spool.labels() for run in done))
        _write_summary(folder, {run.name: (run.counts, run.seconds) for run in done})
    return done


def write_nuscenes_run(
    directory: str | Path,
    runs: Iterable[SmoothedScene],
    dataroot: str | Path,
    version: str,
    meta: ResultMeta,
    suffix: str = ".csv",
) -> tuple[SmoothedScene, ...]:
    """Write the table, the summary, the tracking result and the annotation tables of nuScenes scenes."""
    with atomic_directory(directory) as folder:
        done = tuple(runs)
        _write_common(folder, done, suffix)
        write_tracking_results(folder / "tracking.json", [(run.scene, run.tracks) for run in done], meta)
        write_nuscenes_labels(folder, dataroot, version, [(run.scene, run.labels) for run in done])
    return done


def write_kitti_run(
    directory: str | Path, runs: Iterable[SmoothedScene], dataset: KittiTracking, suffix: str = ".csv"
) -> tuple[SmoothedScene, ...]:
    """Write the table, the summary, label files and results of KITTI sequences."""
    with atomic_directory(directory) as folder:
        done = tuple(runs)
        _write_common(folder, done, suffix)
        write_kitti_labels(folder / "label_02", dataset, [(run.scene, run.labels) for run in done])
        write_kitti_results(folder / "results", dataset, [(run.scene, run.tracks) for run in done])
    return done


def _write_common(folder: Path, runs: Sequence[SmoothedScene], suffix: str) -> None:
    write_label_table(folder / f"labels{suffix}", [(run.scene, run.labels) for run in runs])
    _write_summary(folder, {run.scene.name: (run.counts, run.seconds) for run in runs})


def _write_summary(folder: Path, runs: Mapping[str, tuple[LabelCounts, float]]) -> None:
    """Counts and seconds, by scene and together."""
    total = LabelCounts.sum(counts for counts, _ in runs.values())
    scenes = {name: {**asdict(counts), "seconds": round(seconds, 3)} for name, (counts, seconds) in runs.items()}
    write_figures(folder / "summary.json", {"total": asdict(total), "scenes": scenes})

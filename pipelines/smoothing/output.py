"""Output of a run of smoothing: a folder of labels.

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

from data_tools.datasets.label_table import write_label_table
from data_tools.figures import write_figures
from data_tools.files.atomic_files import atomic_directory
from pipelines.smoothing.scene import SmoothedScene
from pipelines.smoothing.streaming import StreamedScene
from saga_fg.smoothing import LabelCounts, Labels
from saga_fg.types.dataset import Scene

_TABLES = ("labels.csv", "labels.ndjson", "labels.parquet", "summary.json")


def write_labels(
    directory: str | Path,
    runs: Iterable[SmoothedScene],
    suffix: str = ".csv",
    write_others: Callable[[Path, Sequence[tuple[Scene, Sequence[Labels]]]], None] | None = None,
) -> tuple[SmoothedScene, ...]:
    """Write the table of boxes and the summary; the folder is checked before the first run is asked for.

    write_others  adds the labels of all scenes in another format to the folder
    """
    with atomic_directory(directory, known=_TABLES) as folder:
        done = tuple(runs)
        labels = [(run.scene, run.labels) for run in done]
        write_label_table(folder / f"labels{suffix}", labels)
        _write_summary(folder, {run.scene.name: (run.counts, run.seconds) for run in done})
        if write_others is not None:
            write_others(folder, labels)
    return done


def write_streamed_labels(
    directory: str | Path, smooth: Callable[[Path], Iterable[StreamedScene]], suffix: str = ".csv"
) -> tuple[StreamedScene, ...]:
    """Write the labels of recordings smoothed as they are read; `smooth` is called with a folder for their spools."""
    with atomic_directory(directory, known=_TABLES) as folder, TemporaryDirectory(dir=folder) as spools:
        done = tuple(smooth(Path(spools)))
        write_label_table(folder / f"labels{suffix}", chain.from_iterable(run.spool.labels() for run in done))
        _write_summary(folder, {run.name: (run.counts, run.seconds) for run in done})
    return done


def _write_summary(folder: Path, runs: Mapping[str, tuple[LabelCounts, float]]) -> None:
    """Counts and seconds, by scene and together."""
    total = LabelCounts.sum(counts for counts, _ in runs.values())
    scenes = {name: {**asdict(counts), "seconds": round(seconds, 3)} for name, (counts, seconds) in runs.items()}
    write_figures(folder / "summary.json", {"total": asdict(total), "scenes": scenes})

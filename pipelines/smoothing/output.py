"""Smoothing of one recording, and a folder of its labels.

Output of a run of smoothing: a folder of labels.

labels.csv       a row per box (or .ndjson, .parquet)
summary.json     how many boxes of each scene were observed, filled, extended and dropped
tracking.json    nuScenes: the official tracking result
VERSION/         nuScenes: tables whose annotations are the labels
label_02/        KITTI: text as of ground truth
results/         KITTI: the same with scores, as evaluators take it
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory

from data_tools.datasets.detection_files import write_label_table
from data_tools.figures import write_figures
from data_tools.files.atomic_files import atomic_directory
from pipelines.config import Method
from pipelines.smoothing.labelling import count_labels, label_moments
from pipelines.smoothing.passes import SmoothConfig, smooth_objects, track_evidence
from pipelines.smoothing.streaming import StreamedScene
from pipelines.tracking import Progress, one_thread, scene_with_frames
from saga_fg.graph import FactorProvider
from saga_fg.smoothing import LabelCounts, Labels, gather_evidence
from saga_fg.types.dataset import Dataset, Scene
from saga_fg.types.track import Tracks


@dataclass(frozen=True, eq=False)
class SmoothedScene:
    """A recording and its labels, one table for each of its timestamps.

    counts   where the boxes come from
    frames   frames taken in
    seconds  time spent
    """

    scene: Scene
    labels: tuple[Labels, ...]
    counts: LabelCounts
    frames: int
    seconds: float

    @property
    def tracks(self) -> tuple[Tracks, ...]:
        """The labels as tracks."""
        return tuple(moment.tracks for moment in self.labels)


def smooth_scene(
    scene: Scene,
    config: SmoothConfig,
    method: Method = "saga",
    progress: Progress | None = None,
    providers: Sequence[FactorProvider] = (),
) -> SmoothedScene:
    """Smooth one recording, with the edges of the tracker's settings unless `method` is another than `saga`.

    providers: of factors of your own, in place of those that the configuration names
    """
    tracking = config.tracking.of_method(method)
    with one_thread():
        start = time.perf_counter()
        evidence = gather_evidence(scene.frames, scene.timestamps, config.sensors, tracking.tracker.classes)
        tracker = tracking.new_tracker(method)
        classes = tracking.tracker.classes
        track_of = track_evidence(scene.name, scene.frames, tracker, evidence, config.sensors, classes, progress)
        objects = smooth_objects(evidence, track_of, config.smoothing, tracking.tracker, providers)
        labels = label_moments(evidence, objects, scene.timestamps, config.smoothing)
        counts = count_labels(evidence, objects, labels, scene.timestamps)
        seconds = time.perf_counter() - start
    return SmoothedScene(scene, labels, counts, len(scene.frames), seconds)


def smooth_dataset(
    dataset: Dataset,
    config: SmoothConfig,
    method: Method = "saga",
    scenes: Iterable[str] | None = None,
    progress: Progress | None = None,
) -> Iterator[SmoothedScene]:
    """Smooth some recordings (default: all), one at a time as they are asked for."""
    for name in dataset.scenes if scenes is None else scenes:
        yield smooth_scene(scene_with_frames(dataset, name), config, method, progress)


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

"""One recording: detections in, labels out."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from pipelines.config import Method
from pipelines.process import one_thread
from pipelines.smoothing.config import SmoothConfig
from pipelines.smoothing.labelling import count_labels, label_moments
from pipelines.smoothing.passes import smooth_objects, track_evidence
from pipelines.tracking import Progress, scene_with_frames
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

"""Recordings read, labelled as they are read, and kept until they are written.

Labels of a recording at hand are kept in memory; those of one that streams by wait on disk, chunk by chunk
(`saga_fg.smoothing.recording`).
"""

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.datasets.corrections import Outcomes
from pipelines.config import Method
from pipelines.smoothing.configuration import SmoothConfig
from pipelines.tracking import Progress, one_thread, scene_with_frames
from saga_fg.graph import FactorProvider
from saga_fg.smoothing import ChunkSettings, LabelBuilder, LabelCounts, LabelModel, Labels, RecordingLabels, Review
from saga_fg.smoothing.corrections import Correction, corrections_in
from saga_fg.types import Dataset, Scene, Tracks

LabelledParts = Iterable[tuple[Scene, tuple[Labels, ...]]]
"""Parts of a recording, with the labels of each of their timestamps."""


@dataclass(frozen=True, eq=False)
class SmoothedScene:
    """A recording that was smoothed.

    parts    its parts, and their labels; they may be read again and again
    review   its objects, those first that are most worth a look
    counts   where its boxes come from
    frames   frames taken in
    seconds  time spent
    outcomes what became of the corrections that may be about it
    """

    name: str
    parts: LabelledParts
    review: Review
    counts: LabelCounts
    frames: int
    seconds: float
    outcomes: Outcomes = ()

    @property
    def labels(self) -> tuple[Labels, ...]:
        """The labels of all timestamps, in memory."""
        return tuple(moment for _, part in self.parts for moment in part)

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
    corrections: Sequence[Correction] = (),
) -> SmoothedScene:
    """Smooth one recording at once, with the edges of the tracker's settings unless `method` is another than `saga`.

    providers: of factors of your own, in place of those that the configuration names; corrections: those of other
    scenes are left out
    """
    model = label_model(config, method, corrections_in(scene.name, corrections), providers)
    builder = LabelBuilder(config.tracking.new_tracker(method), model)
    run = _labelled(scene.name, [scene], builder, progress)
    return replace(run, parts=((scene, run.labels),))


def smooth_dataset(
    dataset: Dataset,
    config: SmoothConfig,
    method: Method = "saga",
    scenes: Iterable[str] | None = None,
    progress: Progress | None = None,
    corrections: Sequence[Correction] = (),
) -> Iterator[SmoothedScene]:
    """Smooth some recordings (default: all), one at a time as they are asked for."""
    for name in dataset.scenes if scenes is None else scenes:
        yield smooth_scene(scene_with_frames(dataset, name), config, method, progress, corrections=corrections)


def smooth_stream(
    parts: Iterable[Scene],
    config: SmoothConfig,
    folder: Path,
    method: Method = "saga",
    chunks: ChunkSettings | None = None,
    progress: Progress | None = None,
    corrections: Sequence[Correction] = (),
) -> Iterator[SmoothedScene]:
    """Smooth recordings that come in parts: successive scenes of the same name, each beginning after the one before.

    folder: where labels wait on disk; it must outlive the scenes. The frames of a part are of its timestamps. Raises
    `InputError` for what the parts are refused for.
    """
    for number, (name, scene) in enumerate(groupby(parts, key=lambda part: part.name)):
        model = label_model(config, method, corrections_in(name, corrections))
        waiting = StoredParts(folder / f"{number:06d}")
        builder = LabelBuilder(config.tracking.new_tracker(method), model, chunks or ChunkSettings(), waiting)
        yield _labelled(name, scene, builder, progress)


class StoredParts:
    """Named arrays in files of a new folder, in the order they were added."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self._folder, self._count = folder, 0

    def append(self, part: Mapping[str, Any], /) -> None:
        """Write a file."""
        np.savez(self._folder / f"{self._count:06d}.npz", **part)
        self._count += 1

    def __iter__(self) -> Iterator[Mapping[str, Any]]:
        for number in range(self._count):
            with np.load(self._folder / f"{number:06d}.npz", allow_pickle=False) as file:
                yield dict(file)


def label_model(
    config: SmoothConfig,
    method: Method,
    corrections: Sequence[Correction] = (),
    providers: Sequence[FactorProvider] = (),
) -> LabelModel:
    """What the labels of a recording follow from."""
    tracker = config.tracking.of_method(method).tracker
    return LabelModel(tracker, config.sensors, config.smoothing, providers, corrections)


def _labelled(name: str, parts: Iterable[Scene], builder: LabelBuilder, progress: Progress | None) -> SmoothedScene:
    """Take in everything."""
    frames, seconds = 0, 0.0

    def advance(done: int) -> None:
        if progress is not None:
            progress(name, done, frames)

    for part in parts:
        frames += len(part.frames)
        begin = time.perf_counter()
        with one_thread():
            builder.add(part.frames, part.timestamps, advance)
        seconds += time.perf_counter() - begin
    begin = time.perf_counter()
    with one_thread():
        labels, counts = builder.finish(advance)
    seconds += time.perf_counter() - begin
    outcomes = tuple((name, one, why) for one, why in builder.outcomes)
    return SmoothedScene(name, _Spooled(name, labels), labels.review(), counts, frames, seconds, outcomes)


@dataclass(frozen=True, eq=False)
class _Spooled:
    """The labels of a recording, each chunk with a part of the scene without frames or poses."""

    name: str
    labels: RecordingLabels

    def __iter__(self) -> Iterator[tuple[Scene, tuple[Labels, ...]]]:
        for part in self.labels:
            times = np.array([moment.tracks.timestamp for moment in part])
            yield Scene(self.name, times, np.tile(np.eye(4), (len(times), 1, 1)), ("",) * len(times), ()), part

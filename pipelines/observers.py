"""Observers of a tracker at work: a clock of its stages, and its innovations."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

import numpy as np

from saga_fg.numerics.arrays import FloatArray
from saga_fg.tracking import Stage, TrackerView


class StageClock:
    """CPU time of each stage of a frame, added up. `start()` is to be called before every frame."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._mark = 0.0

    def start(self) -> None:
        """Begin a frame."""
        self._mark = time.thread_time()

    def after(self, stage: Stage, view: Callable[[], TrackerView]) -> None:
        """Add the time of a stage that is done."""
        now = time.thread_time()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._mark
        self._mark = now


class InnovationRecorder:
    """Squared distances of tracks and the detections they took, in sigmas (NIS, 2 degrees of freedom), by class."""

    def __init__(self) -> None:
        self._parts: dict[str, list[FloatArray]] = {}

    def after(self, stage: Stage, view: Callable[[], TrackerView]) -> None:
        """Record the matches of a frame."""
        if stage != "associate":
            return
        now = view()
        assert now.matching is not None
        labels = now.table.label[now.matching.track]
        for label in np.unique(labels).tolist():
            self._parts.setdefault(label, []).append(now.matching.distance[labels == label])

    @property
    def by_class(self) -> Mapping[str, FloatArray]:
        """The squared distances of each class that was ever matched."""
        return {label: np.concatenate(parts) for label, parts in sorted(self._parts.items())}

"""The labelled objects of a recording as one table over its moments, and their places between these."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, StrArray
from saga_fg.types.dataset import Scene

LABEL_GAP = 1.1  # s between labels that are joined by a straight line


@dataclass(frozen=True, eq=False)
class LabelledObjects:
    """N objects at K moments, NaN where they are not labelled.

    time (K,) s; id (N,), label (N,); length (N,) m, 0 where unknown; position (K, N, 2) m, world, or about some origin;
    heading (K, N) rad and velocity (K, N, 2) m/s, NaN where unknown
    """

    time: FloatArray
    id: StrArray
    label: StrArray
    length: FloatArray
    position: FloatArray
    heading: FloatArray
    velocity: FloatArray

    @classmethod
    def of(cls, scene: Scene) -> Self:
        """All objects of a scene. Raises `InputError` for one without ground truth."""
        if scene.ground_truth is None:
            raise InputError(f"scene {scene.name}: expected ground truth, there is none")
        truth = scene.ground_truth
        names = np.unique(np.concatenate([np.empty(0, dtype=np.str_), *(moment.id for moment in truth)]))
        K, N = len(truth), len(names)
        position, velocity, heading = np.full((K, N, 2), np.nan), np.full((K, N, 2), np.nan), np.full((K, N), np.nan)
        length, label = np.zeros(N), np.full(N, "", dtype="U64")
        for k, moment in enumerate(truth):
            at, boxes = np.searchsorted(names, moment.id), moment.boxes
            position[k, at], velocity[k, at], heading[k, at] = boxes.position[:, :2], boxes.velocity, boxes.yaw
            length[at], label[at] = np.nan_to_num(boxes.size[:, 0]), boxes.label
        return cls(scene.timestamps, names, label, length, position, heading, velocity)

    def __len__(self) -> int:
        return len(self.time)

    def at(self, time: float) -> FloatArray:
        """(N, 2) places at a time, s, on the line between labels up to `LABEL_GAP` apart; NaN where there are none."""
        after = int(np.searchsorted(self.time, time - 1e-6))
        if after < len(self.time) and self.time[after] - time < 1e-6:
            return np.asarray(self.position[after])
        if after in (0, len(self.time)) or self.time[after] - self.time[after - 1] > LABEL_GAP:
            return np.full(self.position.shape[1:], np.nan)
        share = (time - self.time[after - 1]) / (self.time[after] - self.time[after - 1])
        return np.asarray((1 - share) * self.position[after - 1] + share * self.position[after])

    def about_their_mean(self) -> Self:
        """With positions about their mean, to the metre."""
        known = np.isfinite(self.position[..., 0])
        origin = np.round(self.position[known].mean(axis=0)) if known.any() else np.zeros(2)
        return replace(self, position=self.position - origin)

    def until(self, time: float) -> Self:
        """The moments up to a time after the first, s."""
        kept = self.time <= self.time[0] + time
        columns = {name: getattr(self, name)[kept] for name in ("time", "position", "heading", "velocity")}
        return replace(self, **columns)

"""Trajectories of the objects of a recording, as one table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import BoolArray, FloatArray, StrArray
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Scene
from saga_fg.types.track import Tracks


@dataclass(frozen=True, eq=False)
class Trajectories:
    """N objects at K moments, NaN where it is not seen.

    time (K,) s; id (N,), label (N,); length (N,) m, 0 where unknown; position (K, N, 2) m from a local origin;
    heading (K, N) rad, NaN where unknown
    """

    time: FloatArray
    id: StrArray
    label: StrArray
    length: FloatArray
    position: FloatArray
    heading: FloatArray

    @classmethod
    def of_truth(cls, scene: Scene) -> Self:
        """The annotated objects. Raises `InputError` for a scene without ground truth."""
        if scene.ground_truth is None:
            raise InputError(f"scene {scene.name}: expected ground truth, there is none")
        rows = [(moment.id, moment.boxes) for moment in scene.ground_truth]
        return cls._of(scene.timestamps, rows)

    @classmethod
    def of_tracks(cls, tracks: Sequence[Tracks]) -> Self:
        """The tracks of a tracker at the times at which they have a detection."""
        seen = [(moment, np.flatnonzero(moment.coasting == 0)) for moment in tracks]
        rows = [(moment.id[at].astype(np.str_), moment.boxes.select(at)) for moment, at in seen]
        return cls._of(np.array([moment.timestamp for moment in tracks]), rows)

    @classmethod
    def _of(cls, time: FloatArray, rows: list[tuple[StrArray, Boxes]]) -> Self:
        names = np.unique(np.concatenate([ids for ids, _ in rows])) if rows else np.empty(0, dtype=np.str_)
        K, N = len(rows), len(names)
        position, heading = np.full((K, N, 2), np.nan), np.full((K, N), np.nan)
        length, label = np.zeros(N), np.full(N, "", dtype="U64")
        for k, (ids, boxes) in enumerate(rows):
            at = np.searchsorted(names, ids)
            position[k, at], heading[k, at] = boxes.position[:, :2], boxes.yaw
            length[at], label[at] = np.nan_to_num(boxes.size[:, 0]), boxes.label
        known = np.isfinite(position[..., 0])
        origin = np.round(position[known].mean(axis=0)) if known.any() else np.zeros(2)
        return cls(time, names, label, length, position - origin, heading)

    def until(self, time: float) -> Self:
        """The moments up to a time after the first, s."""
        return self.moments(self.time <= self.time[0] + time)

    def moments(self, kept: BoolArray | slice) -> Self:
        """Some of the moments."""
        return replace(self, time=self.time[kept], position=self.position[kept], heading=self.heading[kept])

    def __len__(self) -> int:
        return len(self.time)

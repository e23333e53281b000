"""Trajectories of N objects, sampled in time and interpolated between the samples.

Between two samples positions follow the cubic with the given positions and velocities at both ends (Hermite);
velocities and headings are interpolated linearly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, StrArray
from saga_fg.types.boxes import Boxes

AT_SAMPLE = 1e-6  # share of a step within which a time is that of a sample


@dataclass(frozen=True, eq=False)
class SimulatedTrajectories:
    """N objects on the ground at T equally spaced times, in world coordinates.

    id, label  (N,)
    size       (N, 3) m
    time       (T,) s
    position   (T, N, 2) m
    velocity   (T, N, 2) m/s
    yaw        (T, N) rad, not wrapped
    present    (T, N) True while the object exists
    """

    id: StrArray
    label: StrArray
    size: FloatArray
    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    yaw: FloatArray
    present: BoolArray

    def __len__(self) -> int:
        return len(self.id)

    def at(self, time: float) -> tuple[Boxes, BoolArray]:
        """All N boxes at `time`, on the ground z = 0, and a mask (N,) of those that exist at both samples around it."""
        step = self.time[1] - self.time[0]
        k = int(np.clip(np.floor((time - self.time[0]) / step), 0, len(self.time) - 2))
        u = (time - self.time[k]) / step
        p0, p1, v0, v1 = self.position[k], self.position[k + 1], self.velocity[k], self.velocity[k + 1]
        position = (
            (1 + 2 * u) * (1 - u) ** 2 * p0 + u**2 * (3 - 2 * u) * p1 + step * u * (1 - u) * ((1 - u) * v0 - u * v1)
        )
        boxes = Boxes(
            self.label,
            np.column_stack([position, self.size[:, 2] / 2]),
            self.size,
            (1 - u) * self.yaw[k] + u * self.yaw[k + 1],
            (1 - u) * v0 + u * v1,
        )
        before, after = self.present[k] | (u > 1 - AT_SAMPLE), self.present[k + 1] | (u < AT_SAMPLE)
        return boxes, before & after

    def select(self, rows: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> SimulatedTrajectories:
        """The objects of some rows."""
        return replace(
            self,
            **{name: getattr(self, name)[rows] for name in ("id", "label", "size")},
            **{name: getattr(self, name)[:, rows] for name in ("position", "velocity", "yaw", "present")},
        )


def concatenated(parts: Sequence[SimulatedTrajectories]) -> SimulatedTrajectories:
    """All objects of `parts`, which share their times."""
    return SimulatedTrajectories(
        **{name: np.concatenate([getattr(p, name) for p in parts]) for name in ("id", "label", "size")},
        time=parts[0].time,
        **{
            name: np.concatenate([getattr(p, name) for p in parts], axis=1)
            for name in ("position", "velocity", "yaw", "present")
        },
    )


def static_objects(id: StrArray, boxes: Boxes, time: FloatArray) -> SimulatedTrajectories:  # noqa: A002
    """Trajectories of objects that never move."""
    shape = (len(time), len(boxes))
    return SimulatedTrajectories(
        id,
        boxes.label,
        boxes.size,
        time,
        np.broadcast_to(boxes.position[:, :2], (*shape, 2)),
        np.zeros((*shape, 2)),
        np.broadcast_to(boxes.yaw, shape),
        np.ones(shape, dtype=np.bool_),
    )

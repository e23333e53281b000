"""Tracker output: the `Track`s of one moment, as a table (`Tracks`)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray, checked, checked_ids
from saga_fg.numerics.columns import Columns
from saga_fg.types.boxes import Boxes

KNOWN_SPEED_DEVIATION = 2.0  # m/s; a velocity of a larger standard deviation counts as unknown


def speed_deviation(covariance: FloatArray) -> FloatArray:
    """(N,) standard deviation in a mean direction, m/s, of velocities with the covariance (N, 2, 2)."""
    return np.asarray(np.sqrt((covariance[:, 0, 0] + covariance[:, 1, 1]) / 2))


def known_velocities(velocity: FloatArray, covariance: FloatArray) -> FloatArray:
    """(N, 2) the velocities (N, 2), m/s, NaN where their covariance (N, 2, 2) tells that they are unknown.

    A covariance of NaN tells nothing.
    """
    unknown = speed_deviation(covariance) > KNOWN_SPEED_DEVIATION
    return np.where(unknown[:, None], np.nan, velocity)


@dataclass(frozen=True)
class Track:
    """One tracked object at one moment, in world coordinates: a row of `Tracks` (units and frames there)."""

    id: int
    label: str
    position: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw: float
    velocity: tuple[float, float]
    score: float
    position_covariance: FloatArray
    velocity_covariance: FloatArray
    coasting: float


@dataclass(frozen=True, eq=False)
class Tracks(Columns):
    """All tracks of one moment, as columns, in world coordinates.

    timestamp            s
    id                   (N,)       unique, never reused within a run
    boxes                           label, position, size, yaw, velocity (filtered)
    score                (N,)       confidence, comparable within a run
    position_covariance  (N, 2, 2)  of the horizontal position, m^2
    velocity_covariance  (N, 2, 2)  (m/s)^2
    coasting             (N,)       seconds since the last detection, 0 when just updated
    """

    timestamp: float
    id: IntArray
    boxes: Boxes
    score: FloatArray
    position_covariance: FloatArray
    velocity_covariance: FloatArray
    coasting: FloatArray

    def __post_init__(self) -> None:
        n = len(self.boxes)
        vars(self)["id"] = checked_ids("id", self.id, n)
        for name in ("score", "coasting"):
            vars(self)[name] = checked(name, getattr(self, name), (n,))
        for name in ("position_covariance", "velocity_covariance"):
            vars(self)[name] = checked(name, getattr(self, name), (n, 2, 2))

    @classmethod
    def empty(cls, timestamp: float) -> Self:
        none = np.empty(0)
        return cls(
            timestamp,
            np.empty(0, dtype=np.int64),
            Boxes.empty(),
            none,
            np.empty((0, 2, 2)),
            np.empty((0, 2, 2)),
            none,
        )

    def __len__(self) -> int:
        return len(self.boxes)

    def __getitem__(self, row: int) -> Track:
        b = self.boxes
        return Track(
            id=int(self.id[row]),
            label=str(b.label[row]),
            position=tuple(b.position[row].tolist()),
            size=tuple(b.size[row].tolist()),
            yaw=float(b.yaw[row]),
            velocity=tuple(b.velocity[row].tolist()),
            score=float(self.score[row]),
            position_covariance=self.position_covariance[row],
            velocity_covariance=self.velocity_covariance[row],
            coasting=float(self.coasting[row]),
        )

    def __iter__(self) -> Iterator[Track]:
        return (self[row] for row in range(len(self)))

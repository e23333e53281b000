"""Positions and velocities with their covariances: of tracks, and positions seen from a vehicle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from saga_fg.kernels.track_limits import states_within
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.columns import Columns
from saga_fg.numerics.geometry import inverse_transform, transform_points
from saga_fg.types.boxes import MAX_POSITION, MAX_SPEED
from saga_fg.types.track import speed_deviation


class Kinematics(NamedTuple):
    """Position (n, 2) and velocity (n, 2) of n tracks and their covariances (n, 2, 2); 0 for the velocity of fixed
    nodes."""

    position: FloatArray
    velocity: FloatArray
    P: FloatArray
    P_velocity: FloatArray

    def select(self, rows: IntArray) -> Kinematics:
        """The tracks `rows` (k,)."""
        x, v, P, P_v = self
        return Kinematics(x.take(rows, 0), v.take(rows, 0), P.take(rows, 0), P_v.take(rows, 0))

    def append(self, other: Kinematics) -> Kinematics:
        """With the tracks of another after these."""
        return Kinematics(*[np.concatenate(columns) for columns in zip(self, other, strict=True)])

    @property
    def speed_deviation(self) -> FloatArray:
        """(n,) standard deviation of the velocity in a mean direction, m/s."""
        return speed_deviation(self.P_velocity)

    @property
    def deviation(self) -> FloatArray:
        """(n,) standard deviation of the position in the direction in which it is largest, m."""
        middle, half = (self.P[:, 0, 0] + self.P[:, 1, 1]) / 2, (self.P[:, 0, 0] - self.P[:, 1, 1]) / 2
        return np.asarray(np.sqrt(middle + np.hypot(half, self.P[:, 0, 1])))

    def within_limits(self, origin: FloatArray) -> BoolArray:
        """(n,) which states are finite and inside the limits of detections; positions are from `origin` (2,).

        Means and standard deviations have to be within `MAX_POSITION` and `MAX_SPEED`, variances of positions above 0,
        of velocities at least 0. NaN never is within.
        """
        return states_within(*self, origin, MAX_POSITION, MAX_SPEED)


@dataclass(frozen=True, eq=False)
class RelativePositions(Columns):
    """m positions (m, 3) in the vehicle's frame, m, with covariances (m, 2, 2) in its axes, m^2."""

    z: FloatArray
    R: FloatArray

    @classmethod
    def of(cls, world_T_ego: FloatArray, position: FloatArray, R: FloatArray) -> RelativePositions:
        """Transform positions (m, 3) and covariances (m, 2, 2) in the world into the frame of a pose."""
        turn = world_T_ego[:2, :2]
        return cls(transform_points(inverse_transform(world_T_ego), position), turn.T @ R @ turn)

"""Positions and velocities of tracks with their covariances, whatever else their states hold."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.types.boxes import MAX_POSITION, MAX_SPEED


class Kinematics(NamedTuple):
    """Position (n, 2) and velocity (n, 2) of n tracks and their covariances (n, 2, 2); 0 for the velocity of fixed
    nodes."""

    position: FloatArray
    velocity: FloatArray
    P: FloatArray
    P_velocity: FloatArray

    def select(self, rows: IntArray) -> Kinematics:
        """The tracks `rows` (k,)."""
        return Kinematics._make(column[rows] for column in self)

    @property
    def speed_deviation(self) -> FloatArray:
        """(n,) standard deviation of the velocity in a mean direction, m/s."""
        P = self.P_velocity
        return np.asarray(np.sqrt((P[:, 0, 0] + P[:, 1, 1]) / 2))

    def within_limits(self, origin: FloatArray) -> BoolArray:
        """(n,) which states are finite and inside the limits of detections; positions are from `origin` (2,).

        Means and standard deviations have to be within `MAX_POSITION` and `MAX_SPEED`, variances of positions above 0,
        of velocities at least 0. NaN never is within.
        """
        variance, velocity_variance = (np.diagonal(P, axis1=1, axis2=2) for P in (self.P, self.P_velocity))
        within = (
            (np.abs(self.position + origin) <= MAX_POSITION)
            & (np.abs(self.velocity) <= MAX_SPEED)
            & (variance > 0)
            & (variance <= MAX_POSITION**2)
            & (velocity_variance >= 0)
            & (velocity_variance <= MAX_SPEED**2)
        )
        return np.asarray(within.all(axis=1))

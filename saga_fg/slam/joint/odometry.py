"""Odometry: measured motion of a vehicle between epochs, and its noise.

Per interval of dt s and d m, an increment a_T_b has independent noise

    heading      turn_noise^2 dt                     roll, pitch   tilt_noise^2 dt
    translation  distance_noise^2 d + time_noise^2 dt,  every direction

and three slow errors, a scale of the distance, a bias of the yaw rate and an angle of the course, which start as
N(0, scale^2), N(0, bias^2), N(0, course^2) and wander as random walks (see `factors.odometry`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from factors import ERROR_DIM
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, checked, checked_covariances
from saga_fg.numerics.geometry import checked_transform, inverse_transform
from saga_fg.settings import Positive, Settings, setting


@dataclass(frozen=True)
class OdometryNoise(Settings):
    """Noise of an odometry: standard deviations."""

    turn_noise: Positive = setting(0.01, "standard deviation of the heading after one second, rad")
    tilt_noise: Positive = setting(0.001, "standard deviation of roll and pitch after one second, rad")
    distance_noise: Positive = setting(0.03, "standard deviation of the translation after one metre, m")
    time_noise: Positive = setting(0.01, "standard deviation of the translation after one second, m")
    scale: Positive = setting(0.02, "standard deviation of the scale of distances at the start")
    scale_drift: Positive = setting(0.002, "random walk of the scale in one second")
    bias: Positive = setting(0.005, "standard deviation of the yaw-rate bias at the start, rad/s")
    bias_drift: Positive = setting(0.0005, "random walk of the yaw-rate bias in one second, rad/s")
    course: Positive = setting(0.01, "standard deviation of the course against the sensor axes at the start, rad")
    course_drift: Positive = setting(0.0003, "random walk of that course in one second, rad")

    def covariances(self, distance: FloatArray, dt: FloatArray) -> FloatArray:
        """(n, 9, 9) of increments over `distance` (n,) m and `dt` (n,) s > 0.

        Rows: rotation (rad), translation in the frame of the earlier pose (m), change of scale, of bias (rad/s), of
        course (rad).
        """
        tilt, turn = self.tilt_noise**2 * dt, self.turn_noise**2 * dt
        shift = self.distance_noise**2 * distance + self.time_noise**2 * dt
        slow = (self.scale_drift**2 * dt, self.bias_drift**2 * dt, self.course_drift**2 * dt)
        variances = np.stack([tilt, tilt, turn, shift, shift, shift, *slow], axis=1)
        return np.asarray(variances[:, :, None] * np.eye(6 + ERROR_DIM))


@dataclass(frozen=True, eq=False)
class OdometryIncrements:
    """timestamps (n,) s, strictly increasing; a_T_b (n - 1, 4, 4): each pose in the frame of the one before.

    covariances: (n - 1, 6, 6) of the increments where the device states them, as scan registration does: (rotation
    vector, translation) in the frame of the later pose, rad^2, m^2; None: by `OdometryNoise` alone.
    Raises `InputError` for times that do not increase, increments that are not rigid, and invalid covariances.
    """

    timestamps: FloatArray
    a_T_b: FloatArray
    covariances: FloatArray | None = None

    def __post_init__(self) -> None:
        timestamps = checked("timestamps", self.timestamps, (None,))
        if not len(timestamps) or (np.diff(timestamps) <= 0).any():
            raise InputError("timestamps: expected at least one, strictly increasing")
        increments = checked("a_T_b", self.a_T_b, (len(timestamps) - 1, 4, 4))
        for k, increment in enumerate(increments):
            checked_transform(f"a_T_b[{k}]", increment)
        if self.covariances is not None:
            covariances = checked_covariances("covariances", self.covariances, len(increments), 6)
            vars(self)["covariances"] = covariances
        vars(self).update(timestamps=timestamps, a_T_b=increments)

    @classmethod
    def of(cls, timestamps: ArrayLike, world_T_ego: ArrayLike) -> Self:
        """The increments of a path (n, 4, 4)."""
        poses = checked("world_T_ego", world_T_ego, (None, 4, 4))
        return cls(np.asarray(timestamps, dtype=np.float64), inverse_transform(poses[:-1]) @ poses[1:])

    def __len__(self) -> int:
        """The number of epochs."""
        return len(self.timestamps)

    @property
    def dt(self) -> FloatArray:
        """(n - 1,) s"""
        return np.diff(self.timestamps)

    @property
    def distance(self) -> FloatArray:
        """(n - 1,) m"""
        return np.asarray(np.linalg.norm(self.a_T_b[:, :3, 3], axis=1))

    def path(self, start: ArrayLike | None = None) -> FloatArray:
        """World_T_ego (n, 4, 4): the increments one after the other from `start` (4, 4), by default the identity."""
        poses = [np.eye(4) if start is None else checked_transform("start", start)]
        for increment in self.a_T_b:
            poses.append(poses[-1] @ increment)
        return np.stack(poses)

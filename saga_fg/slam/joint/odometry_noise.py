"""Odometry with slow errors: its noise, and motions without them.

A device has slow errors, a scale of the distance, a bias of the yaw rate and an angle of the course, which the joint
estimate has as variables of their own (`factors.odometry_factors`). An increment of dt s and d m has independent noise

    heading      turn_noise^2 dt                     roll, pitch   tilt_noise^2 dt
    translation  distance_noise^2 d + time_noise^2 dt,  every direction

and the slow errors start as N(0, scale^2), N(0, bias^2), N(0, course^2) and wander as random walks. What stands still
beside the vehicle tells them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factors import ERROR_DIM
from saga_fg.numerics import FloatArray, yaw_transform
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

    @property
    def slow(self) -> FloatArray:
        """Deviations (3,) of scale, bias (rad/s) and course (rad) at the start, before any measurement."""
        return np.array([self.scale, self.bias, self.course])

    def wandered(self, dt: FloatArray) -> FloatArray:
        """Variances (3, n) of the changes of scale, bias (rad/s) and course (rad) within dt (n,) s."""
        return np.square([self.scale_drift, self.bias_drift, self.course_drift])[:, None] * dt

    def covariances(self, distance: FloatArray, dt: FloatArray) -> FloatArray:
        """(n, 9, 9) of increments over `distance` (n,) m and `dt` (n,) s > 0.

        Rows: rotation (rad), translation in the frame of the earlier pose (m), change of scale, of bias (rad/s), of
        course (rad).
        """
        tilt, turn = self.tilt_noise**2 * dt, self.turn_noise**2 * dt
        shift = self.distance_noise**2 * distance + self.time_noise**2 * dt
        variances = np.stack([tilt, tilt, turn, shift, shift, shift, *self.wandered(dt)], axis=1)
        return np.asarray(variances[:, :, None] * np.eye(6 + ERROR_DIM))

    def of_increments(self, a_T_b: FloatArray, dt: FloatArray, stated: Sequence[FloatArray | None]) -> FloatArray:
        """(n, 9, 9) of increments a_T_b (n, 4, 4) over dt (n,) s, as of `covariances`.

        stated: for each the covariance (6, 6) that the device states, (rotation vector, translation) in the frame of
        the later pose, rad^2, m^2, which holds in place of that noise; None for none
        """
        P = self.covariances(np.linalg.norm(a_T_b[:, :3, 3], axis=1), dt)
        for row, covariance in enumerate(stated):
            if covariance is not None:
                axes = np.eye(6)
                axes[3:, 3:] = a_T_b[row, :3, :3]
                P[row, :6, :6] = axes @ covariance @ axes.T
        return P


def without_errors(a_T_b: FloatArray, errors: FloatArray, dt: float) -> FloatArray:
    """The motion (4, 4) that a device with slow errors (3,) has reported as a_T_b (4, 4) over `dt` s."""
    scale, bias, course = errors
    motion = yaw_transform(yaw=-bias * dt) @ a_T_b
    motion[:3, 3] = yaw_transform(yaw=-course)[:3, :3] @ a_T_b[:3, 3] / (1 + scale)
    return motion

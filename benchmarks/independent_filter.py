"""Independent Kalman filters of the objects of a recording: constant velocity, measured positions.

An object that was out of sight for a moment is initialised anew.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from saga_fg.model.motion import ConstantVelocity
from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.tracking.box_filter import MOVING
from saga_fg.types.labelled_objects import LabelledObjects

INITIAL_SPEED_DEVIATION = 10.0  # standard deviation of a velocity component before the second measurement, m/s


class FilteredTrajectories(NamedTuple):
    """K moments, N objects: mean (K, N, 4) and covariance (K, N, 4, 4) of x, y, vx, vy; NaN where one is not seen.

    followed (K, N) s in sight without interruption; heading (K, N) rad, the course where the box has none; has_moved
    (K, N) whether one was ever clearly in motion
    """

    mean: FloatArray
    covariance: FloatArray
    followed: FloatArray
    heading: FloatArray
    has_moved: BoolArray


def filter_independently(
    trajectories: LabelledObjects, acceleration_noise: FloatArray, position_noise: float
) -> FilteredTrajectories:
    """All objects of a recording; acceleration_noise (N,) m^2/s^3, position_noise standard deviation, m."""
    K, N = trajectories.position.shape[:2]
    mean, P = np.full((K, N, 4), np.nan), np.full((K, N, 4, 4), np.nan)
    followed = np.full((K, N), np.nan)
    diffusion = ConstantVelocity(1.0).diffusion[2:, 2:] * acceleration_noise[:, None, None]
    R = position_noise**2 * np.eye(2)
    initial = np.diag(np.repeat([position_noise**2, INITIAL_SPEED_DEVIATION**2], 2))
    before = np.zeros(N, dtype=bool)
    for k in range(K):
        seen = np.isfinite(trajectories.position[k, :, 0])
        again, new = np.flatnonzero(seen & before), np.flatnonzero(seen & ~before)
        mean[k, new, :2], mean[k, new, 2:] = trajectories.position[k, new], 0.0
        P[k, new], followed[k, new] = initial, 0.0
        if len(again):
            dt = trajectories.time[k] - trajectories.time[k - 1]
            F = np.eye(4) + dt * np.eye(4, k=2)
            m, C = mean[k - 1, again] @ F.T, F @ P[k - 1, again] @ F.T
            q = diffusion[again]
            C[:, :2, :2] += dt**3 / 3 * q
            C[:, :2, 2:] += dt**2 / 2 * q
            C[:, 2:, :2] += dt**2 / 2 * q
            C[:, 2:, 2:] += dt * q
            gain = np.swapaxes(np.linalg.solve(C[:, :2, :2] + R, C[:, :2]), 1, 2)
            innovation = trajectories.position[k, again] - m[:, :2]
            mean[k, again] = m + (gain @ innovation[:, :, None])[..., 0]
            P[k, again] = C - gain @ C[:, :2]
            followed[k, again] = followed[k - 1, again] + dt
        before = seen
    speed = np.nan_to_num(np.hypot(mean[..., 2], mean[..., 3]))
    deviation = np.sqrt(np.nan_to_num((P[..., 2, 2] + P[..., 3, 3]) / 2, nan=np.inf))
    moved = np.maximum.accumulate((speed > MOVING) & (speed > 3 * deviation), axis=0)
    course = np.arctan2(mean[..., 3], mean[..., 2])
    heading = np.where(np.isfinite(trajectories.heading), trajectories.heading, course)
    return FilteredTrajectories(mean, P, followed, heading, moved)

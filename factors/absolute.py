"""What is known of a pose from outside: its place from a satellite receiver, its tilt from an accelerometer.

    position   r = world_T_pose . translation - z                    GTSAM's `GPSFactor`, z in the local frame, m
    attitude   r = angle between R u_pose and u_world, two turns     GTSAM's `AttitudeFactorPose3`

An accelerometer at rest measures "up" in the frame of the pose, u_pose, where the world says u_world = (0, 0, 1); a
compass does the same with north. Neither measures the turn about its own direction.
"""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors.between import noise_model
from factors.errors import FactorError
from factors.robust import RobustLoss
from factors.validation import checked, checked_keys

_UP = (0.0, 0.0, 1.0)


def position_factor(
    pose_key: int, position: ArrayLike, covariance: ArrayLike, robust: RobustLoss | None = None
) -> gtsam.NonlinearFactor:
    """Return GTSAM's factor of a measured place; position: (3,), m, local frame; covariance: (3, 3), m^2.

    The variable is a `gtsam.Pose3`. Raises `FactorError`.
    """
    (key,) = checked_keys("pose_key", [pose_key])
    measured = checked("position", position, (3,))
    return gtsam.GPSFactor(key, measured, noise_model("covariance", covariance, 3, robust))


def attitude_factor(
    pose_key: int,
    seen: ArrayLike,
    variance: float,
    world: ArrayLike = _UP,
    robust: RobustLoss | None = None,
) -> gtsam.NonlinearFactor:
    """Return GTSAM's factor of a known direction seen from a `gtsam.Pose3`.

    seen: (3,) in the frame of the pose, world: (3,) the same in the world; of any length > 0. variance: rad^2, of
    either turn. Raises `FactorError`.
    """
    (key,) = checked_keys("pose_key", [pose_key])
    noise = noise_model("variance", float(checked("variance", variance, ())) * np.eye(2), 2, robust)
    return gtsam.AttitudeFactorPose3(key, _direction("world", world), noise, _direction("seen", seen))


def _direction(name: str, value: ArrayLike) -> gtsam.Unit3:
    direction = checked(name, value, (3,))
    if not np.linalg.norm(direction) > 0:
        raise FactorError(f"{name}: expected a direction, got a vector of length 0")
    return gtsam.Unit3(direction)

"""Which states can still be tracked: finite, inside the limits that detections have to keep, and with a covariance."""

from __future__ import annotations

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.tracking.joint_state import Kinematics
from saga_fg.types.boxes import MAX_POSITION, MAX_SPEED


def trackable(now: Kinematics, origin: FloatArray) -> BoolArray:
    """(n,) which states are; positions are local, from `origin` (2,) in the world.

    Means and standard deviations have to be within `MAX_POSITION` and `MAX_SPEED`, variances above 0 (of velocities: at
    least 0, since what stands has none). NaN never is.
    """
    variance, velocity_variance = (np.diagonal(P, axis1=1, axis2=2) for P in (now.P, now.P_velocity))
    within = (
        (np.abs(now.position + origin) <= MAX_POSITION)
        & (np.abs(now.velocity) <= MAX_SPEED)
        & (variance > 0)
        & (variance <= MAX_POSITION**2)
        & (velocity_variance >= 0)
        & (velocity_variance <= MAX_SPEED**2)
    )
    return np.asarray(within.all(axis=1))

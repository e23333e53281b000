"""Parts of ROS messages of results, as dictionaries."""

from __future__ import annotations

from typing import Any

import numpy as np

from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import yaw_quaternion

Fields = dict[str, Any]


def header(stamp: int, frame: str) -> Fields:
    """A std_msgs/Header; stamp in ns."""
    seconds, nanoseconds = divmod(stamp, 10**9)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame}


def vector(values: FloatArray) -> Fields:
    """A vector or point (3,); unknown entries are 0."""
    x, y, z = np.nan_to_num(values).tolist()
    return {"x": x, "y": y, "z": z}


def pose(position: FloatArray, yaw: float) -> Fields:
    """A geometry_msgs/Pose; an unknown yaw is 0."""
    w, x, y, z = yaw_quaternion(float(np.nan_to_num(yaw))).tolist()
    return {"position": vector(position), "orientation": {"x": x, "y": y, "z": z, "w": w}}


def covariance(P: FloatArray) -> list[float]:
    """36 entries of a 6 x 6 covariance with a horizontal part (2, 2) alone; unknown is 0."""
    whole = np.zeros((6, 6))
    whole[:2, :2] = np.nan_to_num(P)
    return whole.ravel().tolist()

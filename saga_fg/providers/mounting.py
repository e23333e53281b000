"""Extrinsics of a sensor: its position and rotation in the frame of the pose that the graph estimates."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, TypeVar

import gtsam
import numpy as np

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray

Mounting = tuple[float, float, float, float, float, float]
ON_THE_POSE: Mounting = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
ANTENNA, WHEELS, INERTIAL = range(3)  # ids of calibrations
Provider = TypeVar("Provider")


def mounting(name: str, numbers: Mounting) -> gtsam.Pose3:
    """pose_T_sensor of x, y, z (m), roll, pitch, yaw (rad). Raises `InputError` for other than six finite numbers."""
    if len(numbers) != 6 or not all(map(math.isfinite, numbers)):
        raise InputError(f"{name}: expected six finite numbers x, y, z, roll, pitch, yaw, got {numbers!r}")
    x, y, z, roll, pitch, yaw = numbers
    return gtsam.Pose3(gtsam.Rot3.Ypr(yaw, pitch, roll), np.array([x, y, z]))


def on_pose(provider: Provider, pose_T_vehicle: FloatArray) -> Provider:
    """The provider with its sensor, whose settings say where it is on the vehicle, placed on another pose (4, 4).

    For graphs whose pose is not the vehicle's but, say, a LiDAR's. Providers without a sensor stay as they are.
    """
    settings: Any = provider
    placed: Provider = provider
    onto = gtsam.Pose3(pose_T_vehicle)
    if hasattr(settings, "antenna"):
        placed = replace(settings, antenna=tuple(onto.transformFrom(np.array(settings.antenna)).tolist()))
    if hasattr(settings, "mounted"):
        at = onto.compose(mounting("mounted", settings.mounted))
        placed = replace(settings, mounted=(*at.translation().tolist(), *at.rotation().rpy().tolist()))
    return placed

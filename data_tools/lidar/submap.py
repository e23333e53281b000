"""Submaps: the thinned points of a few dozen metres of way, in a frame of their own.

The frame of a submap is fixed to one of its keyframes: where that keyframe's sensor was, turned so that z points
up. When the estimate of the keyframe's pose changes, the submap moves along, and its points stay as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, checked


@dataclass(frozen=True, eq=False)
class Submap:
    """A piece of the map.

    number             counts submaps from 0 in the order of the drive
    keyframes          numbers of its first keyframe and of the one after its last
    anchor             number of the keyframe that carries the frame
    anchor_T_submap    (4, 4) the frame in that of the anchor's sensor, z up
    points             (N, 3) float32, m, in the submap's frame
    way                m driven since the start of the drive, at its first and at its last keyframe

    Raises `InputError` for points that are not finite.
    """

    number: int
    keyframes: tuple[int, int]
    anchor: int
    anchor_T_submap: FloatArray
    points: npt.NDArray[np.float32]
    way: tuple[float, float]

    def __post_init__(self) -> None:
        object.__setattr__(self, "anchor_T_submap", checked("anchor_T_submap", self.anchor_T_submap, (4, 4)))
        points = np.asarray(self.points, dtype=np.float32)
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise InputError(f"points: expected finite coordinates (N, 3), got an array of shape {points.shape}")
        object.__setattr__(self, "points", points)


def upright(world_T_sensor: FloatArray) -> FloatArray:
    """Return the rotation (4, 4) that turns a sensor's axes so that z points up in the world, and x stays ahead."""
    R = world_T_sensor[:3, :3]
    heading = np.arctan2(R[1, 0], R[0, 0])
    c, s = np.cos(heading), np.sin(heading)
    turned = np.eye(4)
    turned[:3, :3] = R.T @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return turned

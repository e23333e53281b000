"""Lines on the road: curbs, borders of lanes. A straight line on the ground, (theta, rho): n . x = rho.

A bend is a chain of such lines, each as long as it is straight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factors import HesseLine, ResidualFactors, SpatialPose, line_factors
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.settings import Positive, Settings, setting


@dataclass(frozen=True)
class LineLandmark(Settings):
    """A line, observed as the two ends (6,) of the piece seen, in the frame of the pose; its noise is that of the two
    ends across the line, m.
    """

    name: str = setting("road line", "name in files")
    density: Positive = setting(0.2, "expected density of landmarks, 1/(rad m); higher: new landmarks are begun sooner")

    @property
    def pose(self) -> SpatialPose:
        return SpatialPose()

    @property
    def variable(self) -> HesseLine:
        return HesseLine()

    def factors(self, rows: IntArray, observed: FloatArray, covariances: FloatArray) -> list[ResidualFactors]:
        return [line_factors(rows, observed.reshape(-1, 2, 3), covariances)]

    def initialise(self, world_T_pose: FloatArray, observed: FloatArray) -> FloatArray:
        first, second = (observed.reshape(2, 3) @ world_T_pose[:3, :3].T + world_T_pose[:3, 3])[:, :2]
        length = np.linalg.norm(second - first)
        if length == 0.0:
            raise InputError(f"observed {self.name}: expected two ends that are apart from above, got {observed}")
        along = (second - first) / length
        normal = np.array([-along[1], along[0]])
        rho = float(normal @ (first + second) / 2)
        normal, rho = (normal, rho) if rho >= 0 else (-normal, -rho)
        return np.array([np.arctan2(normal[1], normal[0]), rho])

    def coordinates(self, state: FloatArray) -> dict[str, float]:
        theta, rho = state.tolist()
        nx, ny = float(np.cos(theta)), float(np.sin(theta))
        return {"x": rho * nx, "y": rho * ny, "nx": nx, "ny": ny, "rho": rho}

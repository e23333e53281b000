"""Poles: trunks, masts, posts. A vertical line at (x, y) in the world, m; seen at any height."""

from __future__ import annotations

from dataclasses import dataclass

from factors import ResidualFactors, SpatialPose, Vector, relative_detection_factors
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.settings import Positive, Settings, setting


@dataclass(frozen=True)
class PoleLandmark(Settings):
    """A pole, observed as a point (3,) on it in the frame of the pose; its noise is that ahead and to the left."""

    name: str = setting("pole", "name in files")
    density: Positive = setting(0.02, "expected density of landmarks, 1/m^2; higher: new landmarks are begun sooner")

    @property
    def pose(self) -> SpatialPose:
        return SpatialPose()

    @property
    def variable(self) -> Vector:
        return Vector(2)

    def factors(self, rows: IntArray, observed: FloatArray, covariances: FloatArray) -> list[ResidualFactors]:
        return [relative_detection_factors(rows, observed, covariances, state_dim=2)]

    def initialise(self, world_T_pose: FloatArray, observed: FloatArray) -> FloatArray:
        return (world_T_pose[:3, :3] @ observed + world_T_pose[:3, 3])[:2]

    def coordinates(self, state: FloatArray) -> dict[str, float]:
        return {"x": float(state[0]), "y": float(state[1])}

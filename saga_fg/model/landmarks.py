"""Detectors and types of landmarks: points, planes, poles.

Planes: walls, facades, the ground.

The state is n . x + d = 0 in the world, n of length 1 pointing to the side that is seen.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import gtsam

from factors import (
    OrientedPlane,
    PlanarPose,
    ResidualFactors,
    SpatialPose,
    Vector,
    plane,
    plane_factor,
    relative_factors,
)
from saga_fg.errors import InputError
from saga_fg.numerics import FloatArray, IntArray
from saga_fg.parts import part_kind
from saga_fg.settings import Positive, Settings, setting
from saga_fg.types import Frame, Observation


@part_kind("detector of landmarks", "saga_fg.landmarks")
class LandmarkDetector(Protocol):
    """Finds landmarks in the data of a moment: a frame, or the points (N, 3), m, of a scan in the scanner's frame."""

    def observations(self, seen: Frame | FloatArray) -> Sequence[Observation]:
        """Return what is observed: from a frame in the vehicle's coordinates, from points in theirs."""


@dataclass(frozen=True)
class PointLandmark(Settings):
    """A point, observed as its place (dim,) in the frame of the pose."""

    dim: int = setting(2, "dimension: 2 in the plane, 3 in space")
    name: str = setting("point", "name in files")
    density: Positive = setting(
        0.02, "expected density of landmarks, 1/m^2, or 1/m^3; higher: new landmarks are begun sooner"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.dim not in (2, 3):
            raise InputError(f"dim: expected 2 or 3, got {self.dim!r}")

    @property
    def pose(self) -> PlanarPose | SpatialPose:
        return PlanarPose() if self.dim == 2 else SpatialPose()

    @property
    def variable(self) -> Vector:
        return Vector(self.dim)

    def factors(self, rows: IntArray, observed: FloatArray, covariances: FloatArray) -> list[ResidualFactors]:
        return [relative_factors(rows, observed, covariances, self.dim, range(self.dim))]

    def initialise(self, world_T_pose: FloatArray, observed: FloatArray) -> FloatArray:
        return world_T_pose[: self.dim, : self.dim] @ observed + world_T_pose[: self.dim, self.dim]

    def coordinates(self, state: FloatArray) -> dict[str, float]:
        return dict(zip("xyz", state.tolist(), strict=False))


@dataclass(frozen=True)
class PlaneLandmark(Settings):
    """A plane, observed as (n, d) (4,) in the frame of the pose; its noise is that of two turns (rad) and d (m)."""

    pose: ClassVar[SpatialPose] = SpatialPose()
    variable: ClassVar[OrientedPlane] = OrientedPlane()
    name: str = setting("plane", "name in files")
    density: Positive = setting(
        0.05, "expected density of landmarks, 1/(rad^2 m); higher: new landmarks are begun sooner"
    )

    def factors(self, rows: IntArray, observed: FloatArray, covariances: FloatArray) -> list[gtsam.NonlinearFactor]:
        return [
            plane_factor(pose, landmark, z, covariance)
            for (pose, landmark), z, covariance in zip(rows.tolist(), observed, covariances, strict=True)
        ]

    def initialise(self, world_T_pose: FloatArray, observed: FloatArray) -> gtsam.OrientedPlane3:
        return plane("observed plane", observed).transform(gtsam.Pose3(world_T_pose).inverse())

    def coordinates(self, state: gtsam.OrientedPlane3) -> dict[str, float]:
        nx, ny, nz, d = state.planeCoefficients().tolist()
        return {"x": -d * nx, "y": -d * ny, "z": -d * nz, "nx": nx, "ny": ny, "nz": nz, "d": d}


@dataclass(frozen=True)
class PoleLandmark(Settings):
    """A pole, observed as a point (3,) on it in the frame of the pose; its noise is that ahead and to the left."""

    pose: ClassVar[SpatialPose] = SpatialPose()
    variable: ClassVar[Vector] = Vector(2)
    name: str = setting("pole", "name in files")
    density: Positive = setting(0.02, "expected density of landmarks, 1/m^2; higher: new landmarks are begun sooner")

    def factors(self, rows: IntArray, observed: FloatArray, covariances: FloatArray) -> list[ResidualFactors]:
        return [relative_factors(rows, observed, covariances, 2)]

    def initialise(self, world_T_pose: FloatArray, observed: FloatArray) -> FloatArray:
        return (world_T_pose[:3, :3] @ observed + world_T_pose[:3, 3])[:2]

    def coordinates(self, state: FloatArray) -> dict[str, float]:
        return {"x": float(state[0]), "y": float(state[1])}

"""Points: trees in the plane, reflectors in space. The state is the place in the world, (2,) or (3,), m."""

from __future__ import annotations

from dataclasses import dataclass

from factors import PlanarPose, ResidualFactors, SpatialPose, Vector, point_factors
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.settings import Positive, Settings, setting


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
        return [point_factors(rows, observed, covariances)]

    def initialise(self, world_T_pose: FloatArray, observed: FloatArray) -> FloatArray:
        return world_T_pose[: self.dim, : self.dim] @ observed + world_T_pose[: self.dim, self.dim]

    def coordinates(self, state: FloatArray) -> dict[str, float]:
        return dict(zip("xyz", state.tolist(), strict=False))

"""Planes: walls, facades, the ground.

The state is n . x + d = 0 in the world, n of length 1 pointing to the side that is seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam

from factors import OrientedPlane, SpatialPose, plane, plane_factor
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.settings import Positive, Settings, setting


@dataclass(frozen=True)
class PlaneLandmark(Settings):
    """A plane, observed as (n, d) (4,) in the frame of the pose; its noise is that of two turns (rad) and d (m)."""

    name: str = setting("plane", "name in files")
    density: Positive = setting(
        0.05, "expected density of landmarks, 1/(rad^2 m); higher: new landmarks are begun sooner"
    )

    @property
    def pose(self) -> SpatialPose:
        return SpatialPose()

    @property
    def variable(self) -> OrientedPlane:
        return OrientedPlane()

    def factors(self, rows: IntArray, observed: FloatArray, covariances: FloatArray) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        for (pose, landmark), z, covariance in zip(rows.tolist(), observed, covariances, strict=True):
            graph.add(plane_factor(pose, landmark, z, covariance))
        return graph

    def initialise(self, world_T_pose: FloatArray, observed: FloatArray) -> gtsam.OrientedPlane3:
        return plane("observed plane", observed).transform(gtsam.Pose3(world_T_pose).inverse())

    def coordinates(self, state: gtsam.OrientedPlane3) -> dict[str, float]:
        nx, ny, nz, d = state.planeCoefficients().tolist()
        return {"x": -d * nx, "y": -d * ny, "z": -d * nz, "nx": nx, "ny": ny, "nz": nz, "d": d}

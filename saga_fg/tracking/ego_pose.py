"""The vehicle's pose as a variable of the tracks' running graph, and objects seen from it.

Factor providers add and move it (`saga_fg.providers`).
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam

from saga_fg.graph import EGO_POSE, SceneFactorGraph, key_of
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.columns import Columns
from saga_fg.numerics.geometry import inverse_transform, transform_points, yaw_transform


@dataclass(frozen=True, eq=False)
class RelativePositions(Columns):
    """m positions (m, 3) in the vehicle's frame, m, with covariances (m, 2, 2) in its axes, m^2."""

    z: FloatArray
    R: FloatArray

    @classmethod
    def of(cls, world_T_ego: FloatArray, position: FloatArray, R: FloatArray) -> RelativePositions:
        """Transform positions (m, 3) and covariances (m, 2, 2) in the world into the frame of a pose."""
        turn = world_T_ego[:2, :2]
        return cls(transform_points(inverse_transform(world_T_ego), position), turn.T @ R @ turn)


def local_pose(graph: SceneFactorGraph) -> FloatArray | None:
    """The vehicle's present pose (4, 4), counted from the graph's origin; None where no provider has added one."""
    key = key_of(EGO_POSE, 0, graph.epoch) if graph.epoch >= 0 else -1
    if key not in graph.variables:
        return None
    pose = graph.state(key)
    return pose.matrix() if isinstance(pose, gtsam.Pose3) else yaw_transform(pose.x(), pose.y(), 0.0, pose.theta())

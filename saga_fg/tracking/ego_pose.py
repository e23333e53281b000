"""The vehicle's pose as a variable of the tracks' running graph, and objects seen from it.

Factor providers move it (`saga_fg.providers`). What a detection in the vehicle's frame measures is r = R^T (p - t) - z
of the pose (R, t) and the object's place p. Both err together, as both hang on what was seen before, so that a
detection is compared with the covariance of r, and not with that of p.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from factors import relative_detection_factors
from saga_fg.estimators import GraphFilter
from saga_fg.graph import EGO_POSE, SceneFactorGraph, key_of
from saga_fg.model.interactions import POSITION
from saga_fg.model.node import NodeType
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.columns import Columns
from saga_fg.numerics.geometry import inverse_transform, transform_points, yaw_transform


@dataclass(frozen=True, eq=False)
class RelativePositions(Columns):
    """m places (m, 3) in the vehicle's frame, m, with covariances (m, 2, 2) in its axes, m^2."""

    z: FloatArray
    R: FloatArray

    @classmethod
    def of(cls, world_T_ego: FloatArray, position: FloatArray, R: FloatArray) -> RelativePositions:
        """Return places (m, 3) and covariances (m, 2, 2) in the world as they are in the frame of a pose."""
        turn = world_T_ego[:2, :2]
        return cls(transform_points(inverse_transform(world_T_ego), position), turn.T @ R @ turn)


def local_pose(graph: SceneFactorGraph) -> FloatArray | None:
    """The vehicle's present pose (4, 4), counted from the graph's origin; None where no provider has added one."""
    key = key_of(EGO_POSE, 0, graph.epoch) if graph.epoch >= 0 else -1
    if key not in graph.variables:
        return None
    pose = graph.state(key)
    return pose.matrix() if isinstance(pose, gtsam.Pose3) else yaw_transform(pose.x(), pose.y(), 0.0, pose.theta())


def relative_covariances(
    estimator: GraphFilter, ids: IntArray, groups: Sequence[tuple[NodeType, IntArray]]
) -> FloatArray:
    """Covariances (n, 2, 2) of where objects are, seen from the vehicle, in the axes of the world.

    groups: rows of `ids` whose states mean the same, with a type of theirs
    """
    key = key_of(EGO_POSE, 0, estimator.graph().epoch)
    pose = estimator.graph().state(key)
    T, d, result = pose.matrix(), pose.dim(), np.zeros((len(ids), 2, 2))
    n, turn = len(T) - 1, T[:2, :2]
    for node_type, rows in groups:
        x, y = node_type.index(POSITION).tolist()
        states, poses = estimator.mean(ids[rows]), np.broadcast_to(T, (len(rows), *T.shape))
        places = np.tile(T[:n, n], (len(rows), 1))
        places[:, :2] = states[:, [x, y]]
        keys = np.stack([np.zeros(len(rows)), np.arange(1, len(rows) + 1)], axis=1).astype(np.uint64)
        seen = relative_detection_factors(keys, (places - T[:n, n]) @ T[:n, :n], np.eye(2), node_type.dim, (x, y))
        assert seen.jacobians is not None
        J_pose, J_state = (np.asarray(J) for J in seen.jacobians(poses, states))
        G = turn @ np.concatenate([J_pose, J_state], axis=2)
        joint = estimator.covariance_with([key], ids[rows])
        for k, row in enumerate(rows.tolist()):
            mine = np.r_[0:d, d + k * node_type.dim : d + (k + 1) * node_type.dim]
            result[row] = G[k] @ joint[np.ix_(mine, mine)] @ G[k].T
    return result

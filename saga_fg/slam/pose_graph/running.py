"""A pose graph that grows pose by pose, with loops that must agree with the way between their ends.

A pose graph in the plane that grows pose by pose, its estimate by iSAM2; loops are under a robust loss.

The loss bounds what a false loop can do while the graph runs. `settled` decides which loops are false, by consensus of
all of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from factors import Robust, between_factor, pose_prior_factor
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.slam.pose_graph.consensus import Consensus, consensus
from saga_fg.slam.pose_graph.graph import PoseGraph
from saga_fg.slam.pose_graph.optimisation import HELD

_SHORTEST = 1e-6  # m: a sparse matrix takes 0 for no measurement


def shortest_paths(first: IntArray, second: IntArray, length: FloatArray, poses: int, row: int) -> FloatArray:
    """Lengths (poses,) of shortest paths from a pose along measurements (M,) of these lengths; infinite without one."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    low, high = np.minimum(first, second), np.maximum(first, second)
    order = np.lexsort((length, high, low))  # the shortest of several between the same two
    _, once = np.unique(low[order] * poses + high[order], return_index=True)
    kept = order[once]
    joined = csr_array((np.maximum(length[kept], _SHORTEST), (low[kept], high[kept])), shape=(poses, poses))
    return np.asarray(dijkstra(joined, directed=False, indices=row))


_LOSS = Robust("cauchy", 3.0)
_RADIAN = 1.0  # m of way that a radian of turning counts as


@dataclass(frozen=True, eq=False)
class Measured:
    """first_T_second (3, 3) between two poses, with the covariance (3, 3) of its tangent."""

    first: int
    second: int
    first_T_second: FloatArray
    covariance: FloatArray


def path_lengths(steps: FloatArray) -> FloatArray:
    """Length (n,) of steps (n, 3, 3), m: the distance, and a metre for each radian turned."""
    turn = np.abs(np.arctan2(steps[:, 1, 0], steps[:, 0, 0]))
    return np.asarray(np.hypot(steps[:, 0, 2], steps[:, 1, 2]) + _RADIAN * turn)


class RunningPoseGraph:
    """Poses from 0 on, each measured from the one before it, and loops."""

    def __init__(self, world_T_first: FloatArray) -> None:
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(0.02)
        params.relinearizeSkip = 1
        self._solver = gtsam.ISAM2(params)
        self._edges: list[Measured] = []
        self._poses = [world_T_first]
        self._new, self._start = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._new.add(pose_prior_factor(0, world_T_first, HELD * np.eye(3)))
        self._start.insert(0, _pose2(world_T_first))

    def append(self, last_T_new: FloatArray, covariance: FloatArray) -> int:
        """Add a pose by odometry from the last one; returns its number."""
        row = len(self._poses)
        self._poses.append(self._poses[-1] @ last_T_new)
        self._edges.append(Measured(row - 1, row, last_T_new, covariance))
        self._new.add(between_factor(row - 1, row, last_T_new, covariance))
        self._start.insert(row, _pose2(self._poses[-1]))
        return row

    def close(self, loops: list[Measured]) -> None:
        """Add loops, and solve."""
        for loop in loops:
            self._edges.append(loop)
            self._new.add(between_factor(loop.first, loop.second, loop.first_T_second, loop.covariance, _LOSS))
        self._solver.update(self._new, self._start)
        self._new, self._start = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._solver.update()
        values = self._solver.calculateEstimate()
        self._poses = [values.atPose2(row).matrix() for row in range(len(self._poses))]

    def pose(self, row: int) -> FloatArray:
        """The present estimate (3, 3) of a pose."""
        return self._poses[row]

    @property
    def poses(self) -> FloatArray:
        """The present estimates (N, 3, 3)."""
        return np.stack(self._poses)

    def distances(self, row: int) -> FloatArray:
        """Length (N,) of the shortest way from a pose to each along measurements, m: what relative errors grow with."""
        first, second = (
            np.array([getattr(edge, end) for edge in self._edges], dtype=np.int64) for end in ("first", "second")
        )
        length = path_lengths(np.array([edge.first_T_second for edge in self._edges]).reshape(-1, 3, 3))
        return shortest_paths(first, second, length, len(self._poses), row)

    def graph(self, loops: list[Measured] | None = None) -> PoseGraph:
        """The whole graph; loops: in place of those that came."""
        edges = self._edges
        if loops is not None:
            edges = [edge for edge in edges if edge.second == edge.first + 1] + loops
        first, second = (
            np.array([getattr(edge, end) for edge in edges], dtype=np.int64) for end in ("first", "second")
        )
        between = np.array([edge.first_T_second for edge in edges]).reshape(-1, 3, 3)
        information = np.linalg.inv(np.array([edge.covariance for edge in edges]).reshape(-1, 3, 3))
        information = (information + information.swapaxes(1, 2)) / 2
        ids: IntArray = np.arange(len(self._poses), dtype=np.int64)
        return PoseGraph(ids, self.poses, first, second, between, information)

    def settled(self, loops: list[Measured] | None = None) -> Consensus:
        """The graph without false loops, optimised."""
        return consensus(self.graph(loops))


def _pose2(T: FloatArray) -> gtsam.Pose2:
    return gtsam.Pose2(T[0, 2], T[1, 2], np.arctan2(T[1, 0], T[0, 0]))

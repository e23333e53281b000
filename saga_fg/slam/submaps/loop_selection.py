"""Which loops between submaps are true, and how far odometry is off its own noise, once a drive is over.

The graph of anchors, odometry and loops goes through `saga_fg.slam.pose_graph.consensus`, which drops loops that the
rest contradicts. Drift beyond the noise that odometry states would contradict all of them; so its deviations of
rotation and of translation are taken s_g times as large, by the loops that agree: variance components (C. R. Rao 1971),
iterated,

    s_g^2  <-  ( s_g^4 sum_k v_k^T P_k^-1 V_gk P_k^-1 v_k + n )  /  ( s_g^2 sum_k tr( P_k^-1 V_gk P_k^-1 Q_k ) + n )

v_k is the residual of odometry between two anchors, P_k = sum_g s_g^2 V_gk its covariance, Q_k that of the residual,
and n = `_TRUST` speaks for s_g = 1. It begins where every loop fits, and shrinks as false loops leave.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.slam.pose_graph import PoseGraph, consensus, factor_graph, pose_values
from saga_fg.slam.submaps.loops import LoopClosure

_TRUST = 30.0  # residuals, those of ten loops
_ROUNDS, _SETTLED = 30, 0.03

Motion = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class LoopSelection:
    """kept (M,): which loops are true; inflation (2,): of odometry's deviations of rotation and translation, >= 1."""

    kept: BoolArray
    inflation: FloatArray

    def inflated(self, covariance: FloatArray) -> FloatArray:
        """A covariance (6, 6) of odometry."""
        scale = np.repeat(self.inflation, 3)
        return np.asarray(covariance * np.outer(scale, scale))


@dataclass(frozen=True, eq=False)
class _Step:
    """Odometry from an anchor to the next: the motion (4, 4), and (3, 6, 6) its covariance by rotations, by
    translations, and by both together."""

    moved: FloatArray
    parts: FloatArray

    @classmethod
    def of(cls, motions: Sequence[Motion]) -> _Step:
        total, parts = np.eye(4), np.zeros((3, 6, 6))
        for moved, P in motions:
            Ad = gtsam.Pose3(moved).inverse().AdjointMap()
            own = np.zeros((3, 6, 6))
            own[0, :3, :3], own[1, 3:, 3:] = P[:3, :3], P[3:, 3:]
            own[2] = P - own[0] - own[1]
            total, parts = total @ moved, Ad @ parts @ Ad.T + own
        return cls(total, (parts + parts.swapaxes(1, 2)) / 2)

    def covariance(self, inflation: FloatArray) -> FloatArray:
        a, b = inflation
        return np.asarray(a**2 * self.parts[0] + b**2 * self.parts[1] + a * b * self.parts[2])


def select_loops(
    world_T_anchor: FloatArray, motions: Sequence[Motion], anchors: Sequence[int], loops: Sequence[LoopClosure]
) -> LoopSelection:
    """Judge loops between anchors (n, 4, 4), by their numbers; motions: from each keyframe to the next."""
    if not loops:
        return LoopSelection(np.ones(0, dtype=bool), np.ones(2))
    steps = [_Step.of(motions[a:b]) for a, b in pairwise(anchors)]
    inflation, kept = _largest(steps, loops), np.ones(len(loops), dtype=bool)
    for _ in range(_ROUNDS):
        graph = _graph(world_T_anchor, steps, loops, inflation)
        agreed = consensus(graph, too_wide=False)
        before, kept = inflation, agreed.kept[len(steps) :]
        inflation = _inflation(agreed.graph, steps, inflation)
        if (np.abs(np.log(inflation / before)) < _SETTLED).all():
            break
    return LoopSelection(kept, inflation)


def _largest(steps: Sequence[_Step], loops: Sequence[LoopClosure]) -> FloatArray:
    """Inflation (2,) with which every loop fits odometry."""
    found = np.ones((len(loops), 2))
    for row, loop in enumerate(loops):
        way = steps[loop.first : loop.second]
        whole = _Step.of([(step.moved, np.zeros((6, 6))) for step in way])
        parts = np.zeros((3, 6, 6))
        for step in way:
            Ad = gtsam.Pose3(step.moved).inverse().AdjointMap()
            parts = Ad @ parts @ Ad.T + step.parts
        off = gtsam.Pose3(whole.moved).localCoordinates(gtsam.Pose3(loop.first_T_second))
        for g, part in ((0, slice(0, 3)), (1, slice(3, 6))):
            P = (_Step(whole.moved, parts).covariance(found[row]) + loop.covariance)[part, part]
            found[row, g] = max(1.0, float(np.sqrt(off[part] @ np.linalg.solve(P, off[part]) / 3)))
    return np.asarray(found.max(axis=0))


def _graph(
    world_T_anchor: FloatArray, steps: Sequence[_Step], loops: Sequence[LoopClosure], inflation: FloatArray
) -> PoseGraph:
    pairs = [*pairwise(range(len(world_T_anchor))), *((loop.first, loop.second) for loop in loops)]
    measured = [*(step.moved for step in steps), *(loop.first_T_second for loop in loops)]
    covariances = np.array([*(step.covariance(inflation) for step in steps), *(loop.covariance for loop in loops)])
    information = np.linalg.inv(covariances)
    first, second = np.array(pairs, dtype=np.int64).T
    ids = np.arange(len(world_T_anchor), dtype=np.int64)
    information = (information + information.swapaxes(1, 2)) / 2
    return PoseGraph(ids, world_T_anchor, first, second, np.array(measured), information)


def _inflation(graph: PoseGraph, steps: Sequence[_Step], inflation: FloatArray) -> FloatArray:
    """The next inflation, by the solved graph of the loops that agree."""
    marginals = gtsam.Marginals(factor_graph(graph), pose_values(graph.world_T_pose))
    poses = [gtsam.Pose3(T) for T in graph.world_T_pose]
    squares, redundancy = np.full(2, _TRUST), np.full(2, _TRUST)
    for k, step in enumerate(steps):
        relative = poses[k].between(poses[k + 1])
        v, inverse = gtsam.Pose3(step.moved).localCoordinates(relative), np.linalg.inv(step.covariance(inflation))
        joint = marginals.jointMarginalCovariance([k, k + 1])
        J = np.hstack([-relative.inverse().AdjointMap(), np.eye(6)])
        M = J @ np.block([[joint.at(a, b) for b in (k, k + 1)] for a in (k, k + 1)]) @ J.T
        left = inverse - inverse @ M @ inverse
        for g, s in enumerate(inflation):
            V = step.parts[g]
            squares[g] += s**4 * (inverse @ v) @ V @ (inverse @ v)
            redundancy[g] += s**2 * np.trace(left @ V)
    return np.asarray(np.maximum(1.0, np.sqrt(squares / np.maximum(redundancy, 1.0))))

"""Which loops between submaps are true, and how far odometry is off its own noise, once a drive is over.

The graph of anchors, odometry and loops goes through `saga_fg.slam.pose_graph.consensus`, which drops loops that the
rest contradicts. Drift beyond the noise that odometry states would contradict all of them; so its deviations are taken
s times as large, with s by the loops that agree (a variance component; Foerstner 1979):

    s^2 = ( sum_k || e_k ||^2_{P_k} + n ) / ( r + n ),     r = sum_l tr( R_l^-1 S_l )

e_k is the residual of odometry at the solution, r its redundancy, S_l what the graph says of the covariance of loop l,
and n = `_TRUST` speaks for s = 1. It begins where every loop fits, and shrinks as false loops leave.
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

_TRUST = 60.0  # residuals, those of ten loops
_ROUNDS, _SETTLED = 10, 0.05

Motion = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class LoopSelection:
    """kept (M,): which loops are true; inflation: s, at least 1."""

    kept: BoolArray
    inflation: float


def composed(motions: Sequence[Motion]) -> Motion:
    """One motion (4, 4) of several, each with the covariance (6, 6) of its tangent at its end."""
    total, P = np.eye(4), np.zeros((6, 6))
    for moved, covariance in motions:
        Ad = gtsam.Pose3(moved).inverse().AdjointMap()
        total, P = total @ moved, Ad @ P @ Ad.T + covariance
    return total, (P + P.T) / 2


def select_loops(
    world_T_anchor: FloatArray, motions: Sequence[Motion], anchors: Sequence[int], loops: Sequence[LoopClosure]
) -> LoopSelection:
    """Judge loops between anchors (n, 4, 4), by their numbers; motions: from each keyframe to the next."""
    if not loops:
        return LoopSelection(np.ones(0, dtype=bool), 1.0)
    steps = [composed(motions[a:b]) for a, b in pairwise(anchors)]
    inflation, kept = max(1.0, *(_misfit(steps, loop) for loop in loops)), np.ones(len(loops), dtype=bool)
    for _ in range(_ROUNDS):
        graph = _graph(world_T_anchor, steps, loops, inflation)
        agreed = consensus(graph, too_wide=False)
        before, kept = inflation, agreed.kept[len(steps) :]
        inflation = min(inflation, _inflation(agreed.graph, steps, inflation))
        if inflation > (1 - _SETTLED) * before:
            break
    return LoopSelection(kept, inflation)


def _misfit(steps: Sequence[Motion], loop: LoopClosure) -> float:
    """Root mean square of what a loop is off odometry, in standard deviations."""
    expected, P = composed(steps[loop.first : loop.second])
    off = gtsam.Pose3(expected).localCoordinates(gtsam.Pose3(loop.first_T_second))
    return float(np.sqrt(off @ np.linalg.solve(P + loop.covariance, off) / 6))


def _graph(
    world_T_anchor: FloatArray, steps: Sequence[Motion], loops: Sequence[LoopClosure], inflation: float
) -> PoseGraph:
    pairs = [*pairwise(range(len(world_T_anchor))), *((loop.first, loop.second) for loop in loops)]
    measured = [*(T for T, _ in steps), *(loop.first_T_second for loop in loops)]
    covariances = np.array([*(inflation**2 * P for _, P in steps), *(loop.covariance for loop in loops)])
    information = np.linalg.inv(covariances)
    first, second = np.array(pairs, dtype=np.int64).T
    ids = np.arange(len(world_T_anchor), dtype=np.int64)
    information = (information + information.swapaxes(1, 2)) / 2
    return PoseGraph(ids, world_T_anchor, first, second, np.array(measured), information)


def _inflation(graph: PoseGraph, steps: Sequence[Motion], inflation: float) -> float:
    """The next s, by the solved graph of the loops that agree."""
    poses = [gtsam.Pose3(T) for T in graph.world_T_pose]
    squares = 0.0
    for (measured, P), (a, b) in zip(steps, pairwise(poses), strict=True):
        off = gtsam.Pose3(measured).localCoordinates(a.between(b))
        squares += float(off @ np.linalg.solve(P, off))
    marginals, redundancy = gtsam.Marginals(factor_graph(graph), pose_values(graph.world_T_pose)), 0.0
    for row in range(len(steps), len(graph.first)):
        i, j = int(graph.first[row]), int(graph.second[row])
        J = np.hstack([-poses[i].between(poses[j]).inverse().AdjointMap(), np.eye(6)])
        joint = marginals.jointMarginalCovariance([i, j])
        P = np.block([[joint.at(a, b) for b in (i, j)] for a in (i, j)])
        redundancy += float(np.trace(graph.information[row] @ J @ P @ J.T))
    return float(max(1.0, np.sqrt((squares + _TRUST) / (redundancy + _TRUST))))

"""Baselines for the optimisation of pose graphs: GTSAM's own optimisers on the same factors.

* Levenberg-Marquardt from the guess in the graph;
* iSAM2 with QR factorisation (with Cholesky it throws on badly conditioned graphs), a few poses at a time, each
  starting where a measurement from an earlier pose puts it, then updated until the error changes no more. Poses that
  come one by one cost an update each; where loops are large, as on a sphere, every one of these factorises most of the
  graph;
* graduated non-convexity over Levenberg-Marquardt, with truncated least squares and odometry as known inliers.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator

import gtsam
import numpy as np

from factors import pose
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.slam.pose_graph import PoseGraph, factor_graph, pose_array, pose_values, trusted

_UNCHANGED = 1e-9  # relative change of the error below which iSAM2 counts as converged
_ROUNDS = 20  # of relinearisation at most, after the last measurement


def levenberg_marquardt(graph: PoseGraph) -> float:
    """The error that `gtsam.LevenbergMarquardtOptimizer` reaches."""
    factors = factor_graph(graph)
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(200)
    params.setRelativeErrorTol(1e-9)
    optimizer = gtsam.LevenbergMarquardtOptimizer(factors, pose_values(graph.world_T_pose), params)
    return float(factors.error(optimizer.optimize()))


def isam2(graph: PoseGraph, batch: int = 10) -> float:
    """The error that `gtsam.ISAM2` with QR reaches; batch: poses added with an update. Raises `InputError`."""
    if batch < 1:
        raise InputError(f"batch: expected at least one pose, got {batch}")
    factors = factor_graph(graph)
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    solver = gtsam.ISAM2(params)
    estimate = solver.calculateEstimatePose2 if graph.dim == 2 else solver.calculateEstimatePose3
    new, start = gtsam.NonlinearFactorGraph(), pose_values(graph.world_T_pose[:1])
    new.add(factors.at(0))
    waiting = {0: graph.world_T_pose[0]}
    for row, edges in _arrivals(graph):
        for edge in edges:
            new.add(factors.at(1 + edge))
        first, between = int(graph.first[edges[0]]), graph.first_T_second[edges[0]]
        if first == row:
            first, between = int(graph.second[edges[0]]), np.linalg.inv(between)
        waiting[row] = (waiting[first] if first in waiting else estimate(first).matrix()) @ between
        start.insert(row, pose("start", waiting[row]))
        if len(waiting) >= batch:
            solver.update(new, start)
            new, start, waiting = gtsam.NonlinearFactorGraph(), gtsam.Values(), {}
    solver.update(new, start)
    error = factors.error(solver.calculateBestEstimate())
    for _ in range(_ROUNDS):
        for _ in range(params.relinearizeSkip):  # only one of so many updates looks for what to linearise anew
            solver.update()
        before, error = error, factors.error(solver.calculateBestEstimate())
        if abs(before - error) <= _UNCHANGED * before:
            break
    return float(error)


def graduated(graph: PoseGraph) -> tuple[FloatArray, BoolArray]:
    """Poses of `gtsam.GncLMOptimizer` from the guess in the graph, and which measurements (M,) it kept."""
    params = gtsam.GncLMParams()
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers([0, *(1 + np.flatnonzero(trusted(graph))).tolist()])
    optimizer = gtsam.GncLMOptimizer(factor_graph(graph), pose_values(graph.world_T_pose), params)
    poses = pose_array(optimizer.optimize(), graph.dim)
    return poses, np.asarray(optimizer.getWeights())[1:] > 0.5


def _arrivals(graph: PoseGraph) -> Iterator[tuple[int, list[int]]]:
    """Yield each row but the first, lowest of those next to earlier ones, and its edges to these (latest first)."""
    edges_of: list[list[tuple[int, int]]] = [[] for _ in range(len(graph))]
    for edge, (i, j) in enumerate(zip(graph.first.tolist(), graph.second.tolist(), strict=True)):
        edges_of[i].append((j, edge))
        edges_of[j].append((i, edge))
    place = {0: 0}
    waiting = [other for other, _ in edges_of[0]]
    heapq.heapify(waiting)
    while waiting:
        row = heapq.heappop(waiting)
        if row in place:
            continue
        known = sorted(((place[other], edge) for other, edge in edges_of[row] if other in place), reverse=True)
        yield row, [edge for _, edge in known]
        place[row] = len(place)
        for other, _ in edges_of[row]:
            if other not in place:
                heapq.heappush(waiting, other)

"""What GTSAM's own optimisers make of a pose graph: the baselines for ours, on the same factors.

* Levenberg-Marquardt from the guess in the graph;
* iSAM2 with QR factorisation (with Cholesky it throws on badly conditioned graphs), a pose at a time, each starting
  where a measurement from an earlier pose puts it, then updated until the error changes no more.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator

import gtsam
import numpy as np

from factors import pose
from saga_fg.pose_graph import PoseGraph, factor_graph, pose_values

_UNCHANGED = 1e-9  # relative change of the error below which iSAM2 counts as converged
_UPDATES = 50  # at most, after the last measurement


def levenberg_marquardt(graph: PoseGraph) -> float:
    """The error that `gtsam.LevenbergMarquardtOptimizer` reaches."""
    factors = factor_graph(graph)
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(200)
    params.setRelativeErrorTol(1e-9)
    optimizer = gtsam.LevenbergMarquardtOptimizer(factors, pose_values(graph.world_T_pose), params)
    return float(factors.error(optimizer.optimize()))


def isam2(graph: PoseGraph) -> float:
    """The error that `gtsam.ISAM2` with QR reaches."""
    factors = factor_graph(graph)
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    solver = gtsam.ISAM2(params)
    estimate = solver.calculateEstimatePose2 if graph.dim == 2 else solver.calculateEstimatePose3
    prior = gtsam.NonlinearFactorGraph()
    prior.add(factors.at(0))
    solver.update(prior, pose_values(graph.world_T_pose[:1]))
    for row, edges in _arrivals(graph):
        new, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for edge in edges:
            new.add(factors.at(1 + edge))
        first, between = int(graph.first[edges[0]]), graph.first_T_second[edges[0]]
        if first == row:
            first, between = int(graph.second[edges[0]]), np.linalg.inv(between)
        start.insert(row, pose("start", estimate(first).matrix() @ between))
        solver.update(new, start)
    error = factors.error(solver.calculateBestEstimate())
    for _ in range(_UPDATES):
        solver.update()
        before, error = error, factors.error(solver.calculateBestEstimate())
        if abs(before - error) <= _UNCHANGED * before:
            break
    return float(error)


def _arrivals(graph: PoseGraph) -> Iterator[tuple[int, list[int]]]:
    """Each row but the first, the lowest that is connected with earlier ones, and its edges to those (latest first)."""
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

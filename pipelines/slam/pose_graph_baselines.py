"""Baselines for the optimisation of pose graphs: GTSAM's own optimisers on the same factors.

* Levenberg-Marquardt from the starts that ours begins at, beside ours, with the times of both;
* iSAM2 with QR factorisation (with Cholesky it throws on badly conditioned graphs), a few poses at a time, each
  starting where a measurement from an earlier pose puts it, then updated until the error changes no more. Poses that
  come one by one cost an update each; where loops are large, as on a sphere, every one of these factorises most of the
  graph.
"""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import gtsam
import numpy as np

from factors import PlanarPose, ResidualFactor, SpatialPose, Vector, pose, solve
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.pose_graph import (
    LandmarkObservations,
    PoseGraph,
    chordal_poses,
    factor_graph,
    pose_values,
)
from saga_fg.slam.pose_graph.optimisation import SOLVER, graph_values, landmark_factors, placed

_UNCHANGED = 1e-9  # relative change of the error below which iSAM2 counts as converged
_MOST_RUNS, _LONG = 5, 0.5  # that are timed, and CPU seconds of them all
_Result = TypeVar("_Result")
_ROUNDS = 20  # of relinearisation at most, after the last measurement


@dataclass(frozen=True)
class FromStart:
    """Error at the result, and CPU seconds (medians of short runs), of our solver and of
    `gtsam.LevenbergMarquardtOptimizer` from one start.
    """

    start: str
    error: float
    seconds: float
    gtsam_error: float
    gtsam_seconds: float


def from_same_starts(graph: PoseGraph) -> list[FromStart]:
    """Both solvers from the guess in the graph and from the chordal start, on the same factors."""
    factors, seen = factor_graph(graph), landmark_factors(graph)
    native = factor_graph(graph)
    if graph.landmarks is not None:
        for observations in graph.landmarks.observations:
            for factor in _native_factors(observations, len(graph)):
                native.add(factor)
    starts = {"guess": graph}
    if not graph.with_frame_as_pose().components().any():
        starts["chordal"] = placed(graph, chordal_poses(graph))
    rows = []
    for name, start in starts.items():
        values = graph_values(start)
        ours, seconds = _timed(partial(solve, factors, seen, values, SOLVER))
        theirs, their_seconds = _timed(partial(_by_gtsam, native, values))
        rows.append(FromStart(name, ours.error, seconds, float(native.error(theirs)), their_seconds))
    return rows


def _by_gtsam(factors: gtsam.NonlinearFactorGraph, start: gtsam.Values) -> gtsam.Values:
    return gtsam.LevenbergMarquardtOptimizer(factors, start, _levenberg_marquardt()).optimize()


def _timed(run: Callable[[], _Result]) -> tuple[_Result, float]:
    """The result, and the median of the CPU seconds of so many runs as take half a second, from one to five."""
    result, seconds = None, []
    while result is None or (sum(seconds) < _LONG and len(seconds) < _MOST_RUNS):
        began = time.process_time()
        result = run()
        seconds.append(time.process_time() - began)
    return result, float(np.median(seconds))


def _levenberg_marquardt() -> gtsam.LevenbergMarquardtParams:
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(200)
    params.setRelativeErrorTol(1e-9)
    return params


def _native_factors(seen: LandmarkObservations, poses: int) -> Iterator[gtsam.NonlinearFactor]:
    """GTSAM's own factors where it has them, else callbacks."""
    variables = (PlanarPose() if seen.z.shape[1] < 3 else SpatialPose(), Vector(seen.z.shape[1]))
    for pose_row, landmark, z, information in zip(
        seen.pose.tolist(), seen.landmark.tolist(), seen.z, seen.information, strict=True
    ):
        keys = (pose_row, poses + landmark)
        if seen.kind == "point":
            covariance = np.linalg.inv(information)
            residual = partial(_point_residual, z)
            yield ResidualFactor(keys, variables, residual, (covariance + covariance.T) / 2).as_custom_factor()
        elif seen.kind == "bearing":
            model = gtsam.noiseModel.Gaussian.Information(information)
            yield gtsam.BearingFactor2D(*keys, gtsam.Rot2(z[0]), model)
        else:  # GTSAM has the bearing first
            model = gtsam.noiseModel.Gaussian.Information(np.ascontiguousarray(information[::-1, ::-1]))
            yield gtsam.BearingRangeFactor2D(*keys, gtsam.Rot2(z[1]), z[0], model)


def _point_residual(z: FloatArray, at: gtsam.Pose2 | gtsam.Pose3, point: FloatArray) -> FloatArray:
    return np.asarray(at.transformTo(point) - z)


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

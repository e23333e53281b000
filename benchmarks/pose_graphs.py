"""Optimisation of pose graphs beside GTSAM's Levenberg-Marquardt, from the same starts on the same factors."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, TypeVar

import gtsam
import numpy as np
import typer

from benchmarks.generated_graphs import Generated, city, torus
from benchmarks.runner import Rows, each
from data_tools.pose_graphs import read_g2o
from factors import PlanarPose, SpatialPose, Vector, residual_factor, solve
from saga_fg.errors import error_context
from saga_fg.numerics import FloatArray
from saga_fg.slam.pose_graph import (
    PointLandmarks,
    PoseGraph,
    chordal_poses,
    factor_graph,
)
from saga_fg.slam.pose_graph.optimisation import SOLVER, graph_values, landmark_factors, placed


def pose_graphs(
    graphs: Annotated[list[str], typer.Argument(help="Files in the g2o format, torus:POSES, city:POSES.")],
) -> Rows:
    """Solve pose graphs from the guess in the file and from the chordal start, beside GTSAM's optimiser.

    \b
    Example:
      python -m benchmarks pose-graphs data/slam/MIT.g2o data/slam/sphere2500.g2o torus:5000
    """
    for name in each(graphs, "graphs"):
        shape, _, poses = name.partition(":")
        with error_context(name):
            graph = GENERATED[shape](int(poses), seed=0)[0] if shape in GENERATED else read_g2o(name)
            for row in from_same_starts(graph):
                errors = {"error, saga-fg": row.error, "GTSAM": row.gtsam_error}
                seconds = {"CPU s, saga-fg": row.seconds, "ratio to GTSAM": row.seconds / row.gtsam_seconds}
                yield (
                    "pose graphs: half the sum of squares",
                    {"graph": Path(name).stem, "start": row.start, **errors, **seconds},
                )


GENERATED: dict[str, Callable[..., Generated]] = {"city": city, "torus": torus}
_MOST_RUNS, _LONG = 5, 0.5  # that are timed, and CPU seconds of them all
_Result = TypeVar("_Result")


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
        for factor in _native_factors(graph.landmarks, len(graph)):
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


def _native_factors(seen: PointLandmarks, poses: int) -> Iterator[gtsam.NonlinearFactor]:
    """GTSAM has no factor of a point seen from a pose: callbacks."""
    variables = (PlanarPose() if seen.z.shape[1] < 3 else SpatialPose(), Vector(seen.z.shape[1]))
    covariances = np.linalg.inv(seen.information)
    for row, landmark, z, P in zip(seen.pose.tolist(), seen.landmark.tolist(), seen.z, covariances, strict=True):
        residual = partial(_point_residual, z)
        yield from residual_factor((row, poses + landmark), variables, residual, (P + P.T) / 2).custom_factors()


def _point_residual(z: FloatArray, at: gtsam.Pose2 | gtsam.Pose3, point: FloatArray) -> FloatArray:
    return np.asarray(at.transformTo(point) - z)

"""Optimisation of pose graphs beside GTSAM's Levenberg-Marquardt, from the same starts on the same factors.

Pose graphs of known truth, of any size: drives through a city, and a path wound round a torus.

    city    in the plane: steps of 1 m, at every crossing (each 5 steps) straight on, left or right at random;
            measurements to one earlier pose within 1.5 m of each pose, where there is one
    torus   in space: windings round the tube while going once round the hole, headings along the path; measurements
            to the neighbour on the winding before

The noise is Gaussian in the tangent of the measured pose, its information written with each measurement. The guess is
dead reckoning along the path. After the synthetic sets "city10000" and "torus3D" that pose-graph papers use (Kaess et
al., iSAM2, IJRR 2012; Rosen et al., SE-Sync, IJRR 2019).
"""

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
from scipy.spatial import cKDTree

from benchmarks.runner import Rows, each
from data_tools.pose_graphs import read_g2o
from factors import PlanarPose, SpatialPose, Vector, residual_factor, solve
from saga_fg.errors import error_context
from saga_fg.numerics import FloatArray, IntArray, transforms
from saga_fg.slam.pose_graph import (
    PointLandmarks,
    PoseGraph,
    chordal_poses,
    factor_graph,
)
from saga_fg.slam.pose_graph.optimisation import SOLVER, graph_values, landmark_factors, placed

_NEAR, _BLOCK = 1.5, 5  # m, between poses of a city that see the same place; steps between crossings
_APART = 10  # poses, at least, between the two of a loop closure
Generated = tuple[PoseGraph, FloatArray]
"""A graph, and its true poses (N, d + 1, d + 1)."""


def city(poses: int, seed: int, noise: float = 0.05) -> Generated:
    """A graph of a city; noise: m, and a fifth of it in rad."""
    rng = np.random.default_rng(seed)
    turns = np.zeros(poses - 1)
    crossings = np.arange(_BLOCK - 1, poses - 1, _BLOCK)
    turns[crossings] = rng.choice([-np.pi / 2, 0.0, np.pi / 2], len(crossings))
    heading = np.concatenate([[0.0], np.cumsum(turns)])
    steps = np.stack([np.cos(heading[:-1]), np.sin(heading[:-1])], axis=1)
    place = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    pairs = cKDTree(place).query_pairs(_NEAR, output_type="ndarray")
    shuffled = rng.permutation(pairs[pairs[:, 1] - pairs[:, 0] > _APART])
    _, first = np.unique(shuffled[:, 1], return_index=True)  # for each later pose an earlier one at random
    return _measured(transforms(np.column_stack([place, heading])), shuffled[first], noise, rng)


def torus(poses: int, seed: int, windings: int = 20, noise: float = 0.05) -> Generated:
    """A graph of a torus, of four poses a winding at least; noise: m and rad. x is along the path, z nearly outward."""
    rng, per_winding = np.random.default_rng(seed), poses // windings
    round_tube = 2 * np.pi * np.arange(poses + 1, dtype=np.float64) / per_winding
    round_hole, radius = round_tube / windings, per_winding / (2 * np.pi)  # steps of about 1 m
    reach = 3 * radius + radius * np.cos(round_tube)
    place = np.stack([reach * np.cos(round_hole), reach * np.sin(round_hole), radius * np.sin(round_tube)], axis=1)
    middle = 3 * radius * np.stack([np.cos(round_hole), np.sin(round_hole), 0 * round_hole], axis=1)
    ahead = np.diff(place, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    side = np.cross((place - middle)[:-1], ahead)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    true = np.tile(np.eye(4), (poses, 1, 1))
    true[:, :3, :3] = np.stack([ahead, side, np.cross(ahead, side)], axis=2)
    true[:, :3, 3] = place[:-1]
    later = np.arange(per_winding, poses)
    return _measured(true, np.stack([later - per_winding, later], axis=1), noise, rng)


def _measured(true: FloatArray, closures: IntArray, noise: float, rng: np.random.Generator) -> Generated:
    """The graph of true poses, measured from each to the next and between the pairs (n, 2) `closures`."""
    n, planar = len(true), true.shape[1] == 3
    sigma = noise * (np.array([1.0, 1.0, 0.2]) if planar else np.ones(6))
    exp = gtsam.Pose2.Expmap if planar else gtsam.Pose3.Expmap
    steps = np.stack([np.arange(n - 1), np.arange(1, n)], axis=1)
    first, second = np.concatenate([steps, closures.astype(np.int64)]).T
    tangents = sigma * rng.normal(size=(len(first), len(sigma)))
    between = np.linalg.inv(true[first]) @ true[second] @ np.stack([exp(tangent).matrix() for tangent in tangents])
    guess = [true[0]]
    for step in between[: n - 1]:
        guess.append(guess[-1] @ step)
    information = np.broadcast_to(np.diag(1 / sigma**2), (len(first), len(sigma), len(sigma)))
    return PoseGraph(np.arange(n), np.stack(guess), first, second, between, information), true


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

"""The minimum of a pose graph, from several starts.

Pose graphs have many local minima, and the start decides which one a solver finds. Dead reckoning may lie in the basin
of a bad one; the chordal start (`chordal_poses`) uses every measurement and no guess, in closed form. Both are tried,
and the lower error is kept. Where the minimum of the chordal cost is to be certified
(`saga_fg.slam.pose_graph.certificate`) it is a start too. If it is proven to be the global one, the others are tried
only where their own error is lower than what it led to: from far off, solvers take long to find bad minima. The first
pose is fixed, unless priors say where poses are.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from factors import (
    FactorError,
    ResidualFactors,
    Robust,
    Solution,
    SolverSettings,
    between_factor,
    pose,
    pose_prior_factor,
    solve,
)
from saga_fg.errors import InputError
from saga_fg.numerics import FloatArray, IntArray
from saga_fg.slam.pose_graph.certificate import ChordalMinimum, chordal_minimum
from saga_fg.slam.pose_graph.chordal import chordal_poses
from saga_fg.slam.pose_graph.graph import PoseGraph, trusted

HELD = 1e-8  # variance (m^2, rad^2) of the first pose
_FEW = 10  # covariances that are found one by one, at a solution each; more of them all together
_UNLIKE = "expected coordinates and information of sizes that numbers can hold together"
SOLVER = SolverSettings(tolerance=3e-3, relative_tolerance=1e-9)  # about where GTSAM stops: a gain of 1e-5, or 1e-9


@dataclass(frozen=True, eq=False)
class OptimisedPoses:
    """world_T_pose: (N, d + 1, d + 1) at the minimum; error: E there; start: which start led there; errors: E that each
    start led to; solution: the same as the solver gave it, keys being rows of the graph, then of its landmarks;
    chordal: the minimum of the chordal cost, and what is proven about it, where that was asked for; landmarks: (L, d)
    their places.
    """

    world_T_pose: FloatArray
    error: float
    start: str
    errors: Mapping[str, float]
    solution: Solution
    chordal: ChordalMinimum | None = None
    landmarks: FloatArray | None = None

    def covariances(self, rows: IntArray | None = None) -> FloatArray:
        """Covariance (n, k, k) of poses `rows` (n,), or all, each in its tangent: relative to the
        first one, or, where there are priors, in the frame that these are given in.

        Raises `InputError` where the measurements are too unlike in size to say.
        """
        count, k = len(self.world_T_pose), 3 * (self.world_T_pose.shape[-1] - 2)
        chosen = np.arange(count) if rows is None else rows
        try:
            if len(chosen) <= _FEW:
                found = {row: self.solution.marginal(row) for row in chosen.tolist()}
            else:
                found = self.solution.marginals()
        except (RuntimeError, np.linalg.LinAlgError, FactorError) as error:
            raise InputError(f"{_UNLIKE}: the covariances of the poses cannot be computed") from error
        covariances = np.array([found[row] for row in chosen.tolist()]).reshape(-1, k, k)
        if not np.isfinite(covariances).all():
            raise InputError(f"{_UNLIKE}: the covariances of the poses cannot be computed")
        return covariances


def optimise_poses(graph: PoseGraph, robust: Robust | None = None, certify: bool = False) -> OptimisedPoses:
    """Return the poses of least error, from the guess in the graph and from the chordal start.

    robust: a loss over the measurements that do not join successive poses, which may be false loop closures; the errors
    then are robust costs. certify: find the global minimum of the chordal cost too, and start from there as well; if it
    is proven, starts that are worse than where it leads are left out.
    Raises `InputError` for a graph that is not connected, or too badly conditioned, and, to be certified, for
    poses that landmarks alone connect.
    """
    factors = factor_graph(graph, robust)
    starts, chordal = {"guess": graph}, None
    if certify or graph.landmarks is None or not graph.components().any():  # otherwise landmarks hold it together
        starts = {"chordal": placed(graph, chordal_poses(graph)), **starts}
    if certify:
        chordal = chordal_minimum(graph, starts["chordal"].world_T_pose)
        starts = {"chordal minimum": placed(graph, chordal.world_T_pose), **starts}
    seen, proven = landmark_factors(graph), chordal is not None and chordal.certified
    solutions: dict[str, Solution] = {}
    try:
        for name, start in starts.items():
            reached = min((solution.error for solution in solutions.values()), default=np.inf)
            if not proven or not solutions or graph_error(start, robust) < reached:
                solutions[name] = solve(factors, seen, graph_values(start), SOLVER)
    except FactorError as error:
        raise InputError(f"{_UNLIKE}: {error}") from error
    best = min(solutions, key=lambda name: solutions[name].error)
    errors = {name: solution.error for name, solution in solutions.items()}
    values = solutions[best].values
    optimum = solved_graph(graph, values)
    found = None if optimum.landmarks is None else optimum.landmarks.position
    return OptimisedPoses(optimum.world_T_pose, solutions[best].error, best, errors, solutions[best], chordal, found)


def placed(graph: PoseGraph, world_T_pose: FloatArray) -> PoseGraph:
    """The graph at other poses, its landmarks where these see them."""
    start = graph.at(world_T_pose)
    return start if graph.landmarks is None else start.with_landmarks(graph.landmarks.placed(start.world_T_pose))


def landmark_factors(graph: PoseGraph) -> list[ResidualFactors]:
    """Factors of the landmarks, whose keys follow those of the poses."""
    return [] if graph.landmarks is None else [graph.landmarks.factors(len(graph))]


def graph_error(graph: PoseGraph, robust: Robust | None = None) -> float:
    """E at the poses and landmarks of a graph."""
    values = graph_values(graph)
    return float(factor_graph(graph, robust).error(values)) + sum(f.error(values) for f in landmark_factors(graph))


def graph_values(graph: PoseGraph) -> gtsam.Values:
    values = pose_values(graph.world_T_pose)
    if graph.landmarks is not None:
        for row, place in enumerate(graph.landmarks.position):
            values.insert(len(graph) + row, place)
    return values


def solved_graph(graph: PoseGraph, values: gtsam.Values) -> PoseGraph:
    """The graph at the poses and landmarks of GTSAM's values."""
    solved = graph.at(pose_array(values, graph.dim, len(graph)))
    if graph.landmarks is None:
        return solved
    places = np.stack([values.atVector(len(graph) + row) for row in range(len(graph.landmarks.ids))])
    return solved.with_landmarks(graph.landmarks.at(places))


def factor_graph(graph: PoseGraph, robust: Robust | None = None) -> gtsam.NonlinearFactorGraph:
    """GTSAM's factors of a pose graph, keys being its rows.

    First what holds the first pose, or the priors, then measurements, then known places. Raises `InputError` where
    known places alone leave open which way the graph is turned.
    """
    if graph.priors is None and graph.places is not None and not graph.places.orient:
        needed = "two known places" if graph.dim == 2 else "three known places that are not on one line"
        raise InputError(f"expected {needed}, or a known pose: nothing tells which way the graph is turned")
    factors = gtsam.NonlinearFactorGraph()
    k = graph.information.shape[1] if len(graph.information) else 3 * (graph.dim - 1)
    if not graph.anchored:
        factors.add(pose_prior_factor(0, graph.world_T_pose[0], HELD * np.eye(k)))
    if (priors := graph.priors) is not None:
        for row, known, spread in zip(
            priors.pose.tolist(), priors.world_T_pose, _inverses(priors.information), strict=True
        ):
            factors.add(pose_prior_factor(row, known, spread))
    covariances = _inverses(graph.information)
    losses = [None if odometry else robust for odometry in trusted(graph).tolist()]
    for first, second, measured, covariance, loss in zip(
        graph.first.tolist(), graph.second.tolist(), graph.first_T_second, covariances, losses, strict=True
    ):
        factors.add(between_factor(first, second, measured, covariance, loss))
    if (places := graph.places) is not None:
        place_prior = gtsam.PoseTranslationPrior2D if graph.dim == 2 else gtsam.PoseTranslationPrior3D
        for row, place, weight in zip(places.pose.tolist(), places.position, places.information, strict=True):
            factors.add(place_prior(row, place, gtsam.noiseModel.Gaussian.Information(weight)))
    return factors


def pose_values(world_T_pose: FloatArray) -> gtsam.Values:
    """Poses (N, d + 1, d + 1) as GTSAM's values, keys from 0."""
    values = gtsam.Values()
    for row, matrix in enumerate(world_T_pose):
        values.insert(row, pose(f"world_T_pose[{row}]", matrix))
    return values


def pose_array(values: gtsam.Values, dim: int, count: int | None = None) -> FloatArray:
    """The poses of GTSAM's values with keys 0 ... N - 1, as (N, dim + 1, dim + 1); count: N, unless all are poses."""
    at = values.atPose2 if dim == 2 else values.atPose3
    return np.stack([at(row).matrix() for row in range(values.size() if count is None else count)])


def _inverses(matrices: FloatArray) -> FloatArray:
    inverse = np.linalg.inv(matrices)
    return np.asarray((inverse + inverse.swapaxes(1, 2)) / 2)

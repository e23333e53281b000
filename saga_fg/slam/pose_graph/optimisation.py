"""The minimum of a pose graph, from several starts.

Pose graphs have many local minima, and the start decides which one a solver finds. Dead reckoning may lie in the basin
of a bad one; the chordal start (`chordal_poses`) uses every measurement and no guess, in closed form. Both are tried,
and the lower error is kept; so is the minimum of the chordal cost, where it is to be certified
(`saga_fg.slam.pose_graph.certificate`). The first pose is fixed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from factors import FactorError, Robust, Solution, SolverSettings, between_factor, pose, pose_prior_factor, solve
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.slam.pose_graph.certificate import ChordalMinimum, chordal_minimum
from saga_fg.slam.pose_graph.chordal import chordal_poses
from saga_fg.slam.pose_graph.graph import PoseGraph

_ANCHOR = 1e-8  # variance (m^2, rad^2) of the first pose
_FEW = 10  # covariances that are found one by one, at a solution each; more of them all together
_UNLIKE = "expected coordinates and information of sizes that numbers can hold together"
_SOLVER = SolverSettings(tolerance=1e-3)  # steps below a thousandth of a standard deviation are rounding in long chains


@dataclass(frozen=True, eq=False)
class OptimisedPoses:
    """world_T_pose: (N, d + 1, d + 1) at the minimum; error: E there; start: which start led there; errors: E that each
    start led to; solution: the same as the solver gave it, keys being rows of the graph; chordal: the minimum of the
    chordal cost, and what is proven about it, where that was asked for.
    """

    world_T_pose: FloatArray
    error: float
    start: str
    errors: Mapping[str, float]
    solution: Solution
    chordal: ChordalMinimum | None = None

    def covariances(self, rows: IntArray | None = None) -> FloatArray:
        """Covariance (n, k, k) of poses `rows` (n,), or all, each in its tangent, relative to the first one.

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
    then are robust costs. certify: find the global minimum of the chordal cost too, and start from there as well.
    Raises `InputError` for a graph that is not connected, or too badly conditioned.
    """
    factors = factor_graph(graph, robust)
    starts = {"chordal": chordal_poses(graph), "guess": graph.world_T_pose}
    chordal = chordal_minimum(graph, starts["chordal"]) if certify else None
    if chordal is not None:
        starts["chordal minimum"] = chordal.world_T_pose
    try:
        solutions = {name: solve(factors, [], pose_values(start), _SOLVER) for name, start in starts.items()}
    except FactorError as error:
        raise InputError(f"{_UNLIKE}: {error}") from error
    best = min(solutions, key=lambda name: solutions[name].error)
    values = solutions[best].values
    errors = {name: solution.error for name, solution in solutions.items()}
    return OptimisedPoses(pose_array(values, graph.dim), solutions[best].error, best, errors, solutions[best], chordal)


def factor_graph(graph: PoseGraph, robust: Robust | None = None) -> gtsam.NonlinearFactorGraph:
    """GTSAM's factors of a pose graph, keys being its rows, with a prior that holds the first pose."""
    factors = gtsam.NonlinearFactorGraph()
    k = graph.information.shape[1] if len(graph.information) else 3 * (graph.dim - 1)
    factors.add(pose_prior_factor(0, graph.world_T_pose[0], _ANCHOR * np.eye(k)))
    covariances = np.linalg.inv(graph.information)
    covariances = (covariances + covariances.swapaxes(1, 2)) / 2
    successive = np.abs(graph.second - graph.first) == 1
    for first, second, measured, covariance, trusted in zip(
        graph.first.tolist(), graph.second.tolist(), graph.first_T_second, covariances, successive, strict=True
    ):
        factors.add(between_factor(first, second, measured, covariance, None if trusted else robust))
    return factors


def pose_values(world_T_pose: FloatArray) -> gtsam.Values:
    """Poses (N, d + 1, d + 1) as GTSAM's values, keys from 0."""
    values = gtsam.Values()
    for row, matrix in enumerate(world_T_pose):
        values.insert(row, pose(f"world_T_pose[{row}]", matrix))
    return values


def pose_array(values: gtsam.Values, dim: int) -> FloatArray:
    """The poses of GTSAM's values with keys 0 ... N - 1, as (N, dim + 1, dim + 1)."""
    at = values.atPose2 if dim == 2 else values.atPose3
    return np.stack([at(row).matrix() for row in range(values.size())])

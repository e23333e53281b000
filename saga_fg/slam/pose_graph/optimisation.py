"""The minimum of a pose graph, from several starts, and without false loops.

Pose graphs have many local minima, and the start decides which one a solver finds. Dead reckoning may lie in the basin
of a bad one; the chordal start (`chordal_poses`) uses every measurement and no guess, in closed form. Both are tried,
and the lower error is kept. Where the minimum of the chordal cost is to be certified
(`saga_fg.slam.pose_graph.certificate`) it is a start too. If it is proven to be the global one, the others are tried
only where their own error is lower than what it led to: from far off, solvers take long to find bad minima. The first
pose is fixed, unless priors say where poses are.

The true loop closures are chosen in two steps (`consensus`). Odometry (between successive poses), priors, known places
and landmarks are trusted. First, graduated non-convexity with truncated least squares from dead reckoning, c^2 the 99 %
quantile of chi^2: in each step of mu one weighted Gauss-Newton step. s is the distance of a loop in standard
deviations, and the weights of the surrogate are

    w = 1                             s^2 <= mu/(mu+1) c^2
        0                             s^2 >= (mu+1)/mu c^2       mu from c^2 / (2 s_max^2 - c^2) up, by 1.4,
        c/s sqrt(mu(mu+1)) - mu       in between                 until every weight is 0 or 1

Then data snooping: each loop is judged by the solution without it,

    d^2 = r^T ( 1 -+ S )^-1 r,     S = J H^-1 J^T        - for a loop that takes part in H, + for one that does not

whitened. Covariances in files are often far too large and hide false loops; so the gate on d^2 is

    min( c'^2, m k c^2 ),     c'^2: 99.9 % quantile,  k = median of d^2 over the loops taken / median of chi^2

with k the variance of unit weight, and m = 8, because the errors of recorded loops have longer tails than a Gaussian.
The worst loops are removed and the best of the removed ones restored until nothing changes, each time at the minimum
with those that are in: one loop may bend a long chain far. At last those of s^2 <= c^2
at the solution without them come back, until there are none: whatever k, they agree with it.

Sources: Yang, Antonante, Tzoumas, Carlone, Graduated Non-Convexity for Robust Spatial Perception, RA-L 2020; Baarda, A
testing procedure for use in geodetic networks, 1968.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import gtsam
import numpy as np
from scipy.sparse import coo_array, csc_array, csr_array, diags_array
from scipy.sparse.csgraph import dijkstra, minimum_spanning_tree

from factors import (
    FactorError,
    ResidualFactors,
    Robust,
    Solution,
    SolverSettings,
    between_factor,
    linearised,
    pose,
    pose_prior_factor,
    solve,
)
from saga_fg.errors import InputError
from saga_fg.numerics import BoolArray, FloatArray, IntArray, checked
from saga_fg.numerics.geometry import chi_square_quantile
from saga_fg.slam.pose_graph.certificate import ChordalMinimum, chordal_minimum
from saga_fg.slam.pose_graph.chordal import chordal_poses, factorised
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
            covariances = np.array([found[row] for row in chosen.tolist()]).reshape(-1, k, k)
            return checked("covariances", covariances, (None, k, k))
        except (RuntimeError, np.linalg.LinAlgError, FactorError, InputError) as error:
            raise InputError(f"{_UNLIKE}: the covariances of the poses cannot be computed") from error


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
    return solved.with_landmarks(replace(graph.landmarks, position=places))


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


PROBABILITY = 0.99  # of a true loop within c
_CERTAIN = 0.999  # of a true loop within the gate: few of many loops may be lost
_TAILS = 8.0  # m: loops of recordings have tails far longer than Gaussian ones
_FEWEST = 8  # loops that tell a variance of unit weight
_MAX_ROUNDS = 50
_MAX_STAGES = 200
_STEP = 1.4  # of mu, as in the paper
_BINARY = 1e-6  # distance from 0 or 1 at which a weight counts as there
_BLOCK = 200  # loops whose covariances are solved for at once


@dataclass(frozen=True, eq=False)
class Consensus:
    """graph: without the false loops, at the poses of the rest; kept (M,): which measurements are in it."""

    graph: PoseGraph
    kept: BoolArray


def consensus(graph: PoseGraph) -> Consensus:
    """The graph without false loops; priors and observations of landmarks are trusted, as odometry is.

    Raises `InputError` for a graph that measurements between poses do not connect.
    """
    graph.check_connected()
    if not len(graph.first):
        return Consensus(graph, np.ones(0, dtype=bool))
    loop = ~_spanning(graph)
    if not loop.any():
        return Consensus(graph, ~loop)
    problem = _Problem.of(graph)
    values = graph_values(placed(graph, _spanning_start(graph, ~loop)))
    values, weights = _graduated(problem, values, loop)
    values, kept = _readmitted(problem, *_snooped(problem, values, loop, weights > 0.5))
    return Consensus(chosen_edges(solved_graph(graph, values), kept), kept)


def chosen_edges(graph: PoseGraph, kept: BoolArray) -> PoseGraph:
    """The graph with some of its measurements (M,)."""
    return replace(
        graph,
        first=graph.first[kept],
        second=graph.second[kept],
        first_T_second=graph.first_T_second[kept],
        information=graph.information[kept],
    )


def _spanning(graph: PoseGraph) -> BoolArray:
    """Odometry, and where it has gaps as many of the other measurements as connect its parts."""
    odometry = trusted(graph)
    n = len(graph)
    cost = np.where(odometry, 1.0, 2.0)
    lengths, once = _shortest_edges(graph.first, graph.second, cost, n)
    tree = minimum_spanning_tree(lengths).tocoo()
    low, high = np.minimum(graph.first, graph.second)[once], np.maximum(graph.first, graph.second)[once]
    return np.asarray(odometry | np.isin(np.arange(len(cost)), once[np.isin(low * n + high, tree.row * n + tree.col)]))


def _spanning_start(graph: PoseGraph, spanning: BoolArray) -> FloatArray:
    """Dead reckoning along these measurements from the first pose."""
    part = chosen_edges(graph, spanning)
    start = PoseGraph.of_measurements(part.ids, part.first, part.second, part.first_T_second, part.information)
    if (priors := graph.priors) is None:
        poses = np.asarray(graph.world_T_pose[0] @ start.world_T_pose)
        return poses if graph.places is None else graph.places.fitted(poses)
    known = int(priors.pose[0])
    return np.asarray(priors.world_T_pose[0] @ np.linalg.inv(start.world_T_pose[known]) @ start.world_T_pose)


@dataclass(frozen=True, eq=False)
class _Problem:
    """The factors of a graph: `held` of the first pose or the priors, edges, then known places; and landmarks seen.

    k: size of the tangent
    """

    factors: gtsam.NonlinearFactorGraph
    held: int
    edges: int
    k: int
    seen: list[ResidualFactors]

    @classmethod
    def of(cls, graph: PoseGraph) -> Self:
        factors, edges = factor_graph(graph), len(graph.first)
        behind = edges + (0 if graph.places is None else len(graph.places.pose))
        return cls(factors, factors.size() - behind, edges, 3 * (graph.dim - 1), landmark_factors(graph))

    @property
    def gate(self) -> float:
        return chi_square_quantile(PROBABILITY, self.k)

    def distances(self, values: gtsam.Values) -> FloatArray:
        """Distances (M,) of the residuals, standard deviations."""
        return np.sqrt([2 * self.factors.at(self.held + edge).error(values) for edge in range(self.edges)])

    def step(self, values: gtsam.Values, weights: FloatArray) -> gtsam.Values:
        """A step of Gauss and Newton with weights (M,)."""
        taken = np.flatnonzero(weights > 0)
        part, full = gtsam.NonlinearFactorGraph(), np.flatnonzero(weights[taken] >= 1)
        for row in [*self.others, *(self.held + taken[full]).tolist()]:
            part.add(self.factors.at(row))
        linear = linearised(part, self.seen, values)
        unit = gtsam.noiseModel.Unit.Create(self.k)
        for edge in taken[weights[taken] < 1].tolist():
            row, root = self.factors.at(self.held + edge).linearize(values), np.sqrt(weights[edge])
            A = root * row.augmentedJacobian()
            first, second = row.keys()
            linear.add(
                gtsam.JacobianFactor(
                    first, A[:, : self.k], second, A[:, self.k : -1], np.ascontiguousarray(A[:, -1]), unit
                )
            )
        try:
            return values.retract(linear.optimize())
        except RuntimeError:  # Cholesky squares the condition number, which odometry that says little makes large
            return values.retract(linear.optimize(function=gtsam.EliminateQR))

    def solved(self, values: gtsam.Values, kept: BoolArray) -> gtsam.Values:
        """The minimum with some of the edges (M,): a loop that returns may bend a long chain far."""
        part = gtsam.NonlinearFactorGraph()
        for row in [*self.others, *(self.held + np.flatnonzero(kept)).tolist()]:
            part.add(self.factors.at(row))
        return solve(part, self.seen, values, SOLVER).values

    @property
    def others(self) -> list[int]:
        """Rows of the factors that are no edges."""
        return [*range(self.held), *range(self.held + self.edges, self.factors.size())]

    def rows(self, values: gtsam.Values) -> tuple[csc_array, FloatArray]:
        """Whitened Jacobian of all factors, edges from row `held` k on, and residuals (M, k) of the edges."""
        linear = linearised(self.factors, self.seen, values)
        row, column, entry = linear.sparseJacobian_()
        whole = coo_array((entry, (row.astype(np.int64) - 1, column.astype(np.int64) - 1))).tocsc()
        size, at = whole.shape[1] - 1, self.held * self.k
        return whole[:, :size].tocsc(), whole[at : at + self.edges * self.k, [size]].toarray().reshape(-1, self.k)


def _graduated(problem: _Problem, values: gtsam.Values, loop: BoolArray) -> tuple[gtsam.Values, FloatArray]:
    """Poses and weights (M,) by truncated least squares."""
    scale = float(np.sqrt(problem.gate))
    ratio = float(np.max(problem.distances(values)[loop], initial=0.0) / scale) ** 2
    mu = 1 / (2 * ratio - 1) if 2 * ratio > 1 else np.inf
    weights = np.ones(len(loop))
    for _ in range(_MAX_STAGES):
        weights[loop] = _surrogate_weights(mu, problem.distances(values)[loop] / scale)
        values = problem.step(values, weights)
        if (np.minimum(weights, 1 - weights) < _BINARY).all():
            break
        mu *= _STEP
    return values, weights


def _surrogate_weights(mu: float, s: FloatArray) -> FloatArray:
    """Weights (M,) of loops at distances s (M,), in units of c, by the surrogate of a parameter mu."""
    if np.isinf(mu):
        return np.asarray((s <= 1).astype(np.float64))
    between = np.sqrt(mu * (mu + 1)) / np.maximum(s, 1e-300) - mu
    return np.asarray(np.where(s**2 <= mu / (mu + 1), 1.0, np.where(s**2 >= (mu + 1) / mu, 0.0, between)))


def _snooped(
    problem: _Problem, values: gtsam.Values, loop: BoolArray, kept: BoolArray
) -> tuple[gtsam.Values, BoolArray]:
    """Take loops out and in, until all that are in pass the gate, and none besides."""
    rows, kept, seen = np.flatnonzero(loop), kept.copy(), {kept.tobytes()}
    for _ in range(_MAX_ROUNDS):
        values = problem.solved(values, kept)
        squares, inside = _judged(problem, values, rows, kept), kept[rows]
        gate = chi_square_quantile(_CERTAIN, problem.k)
        if inside.sum() >= _FEWEST:
            k = float(np.median(squares[inside])) / chi_square_quantile(0.5, problem.k)
            gate = min(gate, _TAILS * k * problem.gate)
        outlying, fitting = inside & (squares > gate), ~inside & (squares <= gate)
        if outlying.any():
            kept[rows[outlying & (squares >= squares[outlying].max() / 2)]] = False
        elif fitting.any():
            kept[rows[np.argmin(np.where(fitting, squares, np.inf))]] = True
        if kept.tobytes() in seen:
            break
        seen.add(kept.tobytes())
    return problem.solved(values, kept), kept


def _readmitted(problem: _Problem, values: gtsam.Values, kept: BoolArray) -> tuple[gtsam.Values, BoolArray]:
    """Take in what was left out and agrees with the solution, until nothing does."""
    while (agreeing := ~kept & (problem.distances(values) <= np.sqrt(problem.gate))).any():
        kept = kept | agreeing
        values = problem.solved(values, kept)
    return values, kept


def _judged(problem: _Problem, values: gtsam.Values, edges: IntArray, kept: BoolArray) -> FloatArray:
    """d^2 of loops (n,), each by a solution without it; infinite where the others do not determine it."""
    k = problem.k
    J, r = problem.rows(values)
    at = problem.held * k
    taken = np.ones(J.shape[0])
    taken[at : at + problem.edges * k] = np.repeat(kept.astype(float), k)
    solver = factorised((J.T @ diags_array(taken) @ J).tocsc())
    found = np.empty(len(edges))
    J = J.tocsr()[at:]
    for first in range(0, len(edges), _BLOCK):
        block = edges[first : first + _BLOCK]
        part = J[(block[:, None] * k + np.arange(k)).ravel()]
        spread = part @ solver.solve(part.T.toarray())
        own = np.arange(len(block) * k).reshape(-1, k)
        S = np.asarray(spread)[own[:, :, None], own[:, None, :]]
        M = np.eye(k) + np.where(kept[block], -1.0, 1.0)[:, None, None] * (S + S.swapaxes(1, 2)) / 2
        smallest = np.linalg.eigvalsh(M)[:, 0]
        M[smallest <= 1e-9] = np.eye(k)
        squares = (r[block] * np.linalg.solve(M, r[block][:, :, None])[:, :, 0]).sum(axis=1)
        found[first : first + _BLOCK] = np.where(smallest <= 1e-9, np.inf, squares)
    return found


_SHORTEST = 1e-6  # m: a sparse matrix takes 0 for no measurement


def shortest_paths(first: IntArray, second: IntArray, length: FloatArray, poses: int, row: int) -> FloatArray:
    """Lengths (poses,) of shortest paths from a pose along measurements (M,) of these lengths; infinite without one."""
    return np.asarray(dijkstra(_shortest_edges(first, second, length, poses)[0], directed=False, indices=row))


def _shortest_edges(first: IntArray, second: IntArray, length: FloatArray, poses: int) -> tuple[csr_array, IntArray]:
    """Lengths (poses, poses) of the shortest of several measurements (M,) between the same two, and their rows."""
    low, high = np.minimum(first, second), np.maximum(first, second)
    order = np.lexsort((length, high, low))
    _, once = np.unique(low[order] * poses + high[order], return_index=True)
    kept = order[once]
    entries = (np.maximum(length[kept], _SHORTEST), (low[kept], high[kept]))
    return csr_array(entries, shape=(poses, poses)), kept

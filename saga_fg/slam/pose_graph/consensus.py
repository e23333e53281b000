"""Selection of the true loop closures of a pose graph.

Odometry (between successive poses), priors, known places and landmarks are trusted. First, graduated non-convexity
with truncated least squares from dead reckoning, c^2 the 99 % quantile of chi^2: in each step of mu one weighted
Gauss-Newton step. s is the distance of a loop in standard deviations, and the weights of the surrogate are

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

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.sparse import coo_array, csc_array, csr_array, diags_array
from scipy.sparse.csgraph import dijkstra, minimum_spanning_tree
from scipy.stats import chi2

from factors import ResidualFactors, linearised, solve
from saga_fg.errors import InputError
from saga_fg.numerics import BoolArray, FloatArray, IntArray
from saga_fg.slam.pose_graph.chordal import factorised
from saga_fg.slam.pose_graph.graph import PoseGraph, trusted
from saga_fg.slam.pose_graph.optimisation import (
    SOLVER,
    factor_graph,
    graph_values,
    landmark_factors,
    placed,
    solved_graph,
)

PROBABILITY = 0.99  # of a true loop within c
_CERTAIN = 0.999  # of a true loop within the gate: few of many loops may be lost
_TAILS = 8.0  # m: loops of recordings have tails far longer than Gaussian ones
_FEWEST = 8  # loops that tell a variance of unit weight
_MOST_ROUNDS = 50
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
    apart = graph.components() != 0
    if apart.any():
        raise InputError(f"pose {int(graph.ids[apart][0])}: expected measurements that connect it with the first pose")
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
    low, high = np.minimum(graph.first, graph.second), np.maximum(graph.first, graph.second)
    order = np.lexsort((cost, high, low))  # the cheapest of several between the same two
    pairs = low[order] * n + high[order]
    once = order[np.concatenate([[True], pairs[1:] != pairs[:-1]])]
    tree = minimum_spanning_tree(csr_array((cost[once], (low[once], high[once])), shape=(n, n))).tocoo()
    return np.asarray(
        odometry | np.isin(np.arange(len(low)), once[np.isin(low[once] * n + high[once], tree.row * n + tree.col)])
    )


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
    def of(cls, graph: PoseGraph) -> _Problem:
        factors, edges = factor_graph(graph), len(graph.first)
        behind = edges + (0 if graph.places is None else len(graph.places.pose))
        return cls(factors, factors.size() - behind, edges, 3 * (graph.dim - 1), landmark_factors(graph))

    @property
    def gate(self) -> float:
        return float(chi2.ppf(PROBABILITY, self.k))

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
    rows = np.flatnonzero(loop)
    seen: set[bytes] = set()
    squares = np.zeros(len(rows))
    judged = np.ones(len(rows), dtype=bool)
    kept = kept.copy()
    for _ in range(_MOST_ROUNDS):
        values = problem.solved(values, kept)
        whole = bool(judged.all())
        squares[judged] = _judged(problem, values, rows[judged], kept)
        inside = kept[rows]
        gate = float(chi2.ppf(_CERTAIN, problem.k))
        if inside.sum() >= _FEWEST:
            k = float(np.median(squares[inside])) / float(chi2.median(problem.k))
            gate = min(gate, _TAILS * k * problem.gate)
        judged = inside | (squares < 10 * problem.gate)  # the others stay far out, unless the solution has improved
        outlying, fitting = inside & (squares > gate), ~inside & (squares <= gate)
        if outlying.any():
            kept[rows[outlying & (squares >= squares[outlying].max() / 2)]] = False
        elif fitting.any():
            kept[rows[np.argmin(np.where(fitting, squares, np.inf))]] = True
        elif whole:
            break
        else:
            judged[:] = True
            continue
        if (state := kept.tobytes()) in seen:
            break
        seen.add(state)
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
    low, high = np.minimum(first, second), np.maximum(first, second)
    order = np.lexsort((length, high, low))  # the shortest of several between the same two
    _, once = np.unique(low[order] * poses + high[order], return_index=True)
    kept = order[once]
    joined = csr_array((np.maximum(length[kept], _SHORTEST), (low[kept], high[kept])), shape=(poses, poses))
    return np.asarray(dijkstra(joined, directed=False, indices=row))

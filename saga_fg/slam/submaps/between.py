"""Factors between submaps: what closed ones leave, and loops.

A closed submap as one factor between its anchor and the next one.

The variables of the submap are eliminated; the marginal that they leave on the two anchors A and B is a Gaussian on
increments. In the coordinates

    y = ( log(A_0^-1 A),  log(R_0^-1 A^-1 B) ),        R_0 = A_0^-1 B_0

the second part does not change when both anchors move as one, as they do when a loop closes far away. Factors that
speak of relative poses alone, odometry and walls, leave rows on this part only, and become a measured motion. What
refers to the world (positions by GPS, the vertical) leaves rows on the first part too; then || W y - c || is a factor
as it is, and so where there are variables for all time (calibrations), which are then part of y. After G. Grisetti,
R. Kuemmerle, K. Ni, "Robust optimization of factor graphs by using condensed measurements", IROS 2012.

Variables of the newest epoch that go on (velocity, bias) keep their own marginal: their correlation with the motion
before is left out.

Loops between submaps: their factors, and which are true and how far odometry is off, once a drive is over.

A loop that passed its proof is false with probability `_FALSE` only. Odometry alone never speaks against it: the
deviations of odometry's rotation and translation are s_1 and s_2 >= 1 times those stated, as the loops have it. For
some of the loops, K, with the residuals e of odometry's steps and r of loops at their solution,

    cost(K, s) = sum e^T Q(s)^-1 e + sum_K r^T R^-1 r  +  log |H| + log |Q(s)| + log |R_K|  +  2 log s_1 s_2

is -2 log of their likelihood: Q(s) inflated covariance of odometry, R their own, H the information of all anchors; the
prior of s is 1 / s. The first five terms are m^T C^-1 m + log |C| of what loops say against dead reckoning, m, whose
covariance C = J Q J^T + R is dense wherever cycles overlap. A loop that is left out, predicted with covariance P, has
errors of rotation and of translation of its own besides, t_1 and t_2, by moments, and costs

    r^T V^-1 r + log |V| - 2 log `_FALSE`,      V = P + R + diag(t_1^2 1, t_2^2 1)

With odometry inflated by some s, the loops that agree are those of `saga_fg.slam.pose_graph.optimisation`. Each choice
that some s leads to gets the s that fits it; the cheapest is taken. So a loop alone stays, and several that agree.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Self

import gtsam
import numpy as np
from scipy.optimize import minimize
from scipy.sparse import coo_array

from factors import Robust, Solution, Variable, between_factor, residual_factor, solve
from saga_fg.errors import InputError
from saga_fg.graph import Additions, Factor, GraphView, LinearisationPoint, PriorGroup, stacked
from saga_fg.numerics import (
    BoolArray,
    FloatArray,
    IntArray,
    carried_covariance,
    checked,
    checked_transform,
    inverse_transform,
)
from saga_fg.slam.mapping import pose_key
from saga_fg.slam.pose_graph import (
    SOLVER,
    PoseGraph,
    PosePriors,
    chosen_edges,
    consensus,
    factor_graph,
    factorised,
    graph_values,
)

_MIN_ROOT = 1e-3  # root of the information that counts as none: a deviation of 1000 m or rad


@dataclass(frozen=True)
class CondensedSubmap:
    """Closes a submap; anchor, successor: keys of its first pose and of that of the next."""

    anchor: int
    successor: int
    name: str = "submaps"

    def factors(self, marginal: Sequence[gtsam.JacobianFactor], point: LinearisationPoint) -> list[Factor]:
        both = [self.anchor, self.successor]
        keys, J = _stacked(marginal, point, both)
        others = [key for key in keys if key not in both]
        gone_on = [key for key in others if point.variables[key].epoch is not None]
        for_all_time = [key for key in others if key not in gone_on]
        made = [self._between(for_all_time, _marginal(keys, J, [*both, *for_all_time], point), point)]
        W, c = _compressed(_marginal(keys, J, gone_on, point))
        return made if not len(c) else [*made, _factor(gone_on, W, c, point)]

    def _between(self, for_all_time: Sequence[int], J: FloatArray, point: LinearisationPoint) -> Factor:
        """The factor of the two poses, by rows [J | b] on increments of these and of variables for all time."""
        keys = self.anchor, self.successor
        rel = point.values.atPose3(self.anchor).between(point.values.atPose3(self.successor))
        columns = J.copy()
        columns[:, :6] += J[:, 6:12] @ rel.inverse().AdjointMap()  # of y: d(B) = d(rel) + Ad d(A)
        if for_all_time or np.abs(columns[:, :6]).max(initial=0.0) >= _MIN_ROOT:
            return _factor([*keys, *for_all_time], *_compressed(columns), point, rel)
        R = np.linalg.qr(columns[:, 6:])[1]
        step, root = np.linalg.solve(R[:6, :6], R[:6, 6]), np.linalg.inv(R[:6, :6])
        return between_factor(*keys, rel.retract(step).matrix(), root @ root.T)


def _factor(
    keys: Sequence[int], W: FloatArray, c: FloatArray, point: LinearisationPoint, rel: gtsam.Pose3 | None = None
) -> Factor:
    """The factor || W y - c || on increments of some variables from where they are; rel: of the second to the first."""
    types = tuple(point.variables[key].type for key in keys)
    states = [kind.read(point.values, key) for kind, key in zip(types, keys, strict=True)]
    if rel is not None:
        states[1] = rel
    residual = _Condensed(types, tuple(states), W, c, rel is not None).residual
    return residual_factor(tuple(keys), types, residual, np.eye(len(c)), name="submap")


@dataclass(frozen=True, eq=False)
class _Condensed:
    """W y - c of increments from some states; relative: the second is that of a pose in the frame of the first."""

    types: tuple[Variable, ...]
    states: tuple[Any, ...]
    W: FloatArray
    c: FloatArray
    relative: bool

    def residual(self, *now: Any) -> FloatArray:
        if self.relative:
            now = (now[0], now[0].between(now[1]), *now[2:])
        y = [kind.local(at, x) for kind, at, x in zip(self.types, self.states, now, strict=True)]
        return np.asarray(self.W @ np.concatenate(y) - self.c)


def _stacked(
    marginal: Sequence[gtsam.JacobianFactor], point: LinearisationPoint, first: Sequence[int]
) -> tuple[list[int], FloatArray]:
    """Keys, `first` in front, and all rows [J | b] on increments from the point."""
    here = gtsam.GaussianFactorGraph()
    for factor in marginal:
        for row in PriorGroup(stacked([factor], point.dims(factor.keys()))).here(np.array([0]), point):
            here.push_back(row)
    found, ordering = set(here.keyVector()), gtsam.Ordering()
    keys = [*(key for key in first if key in found), *sorted(found.difference(first))]
    for key in keys:
        ordering.push_back(key)
    return keys, here.augmentedJacobian(ordering)


def _marginal(keys: Sequence[int], J: FloatArray, kept: Sequence[int], point: LinearisationPoint) -> FloatArray:
    """Rows [J | b] of the marginal of some variables, the others eliminated as far as they are determined."""
    spans, start = {}, 0
    for key in keys:
        spans[key] = np.arange(start, start + point.variables[key].dim)
        start += point.variables[key].dim
    if not len(kept):
        return np.empty((0, 1))
    mine = np.concatenate([spans[key] for key in kept])
    others = np.setdiff1d(np.arange(start), mine)
    U, s, _ = np.linalg.svd(J[:, others], full_matrices=True)
    rank = int((s > _MIN_ROOT).sum())
    rows: FloatArray = U[:, rank:].T @ J[:, [*mine, J.shape[1] - 1]]
    return rows


def _compressed(J: FloatArray) -> tuple[FloatArray, FloatArray]:
    """W and c with || W y - c || = || J y - b || but for a constant; J: [J | b]."""
    U, s, Vt = np.linalg.svd(J[:, :-1], full_matrices=False)
    kept = s > _MIN_ROOT
    return s[kept, None] * Vt[kept], U[:, kept].T @ J[:, -1]


@dataclass(frozen=True, eq=False)
class LoopClosure:
    """`second` seen from `first`, keyframes, submaps or their anchors: first_T_second (4, 4), covariance (6, 6) of its
    tangent.

    confirmed: by another loop or by its proof, where odometry says otherwise; it is under no robust loss
    Raises `InputError`, naming both ends, for what is no rigid transform, and for a covariance that is not positive
    definite.
    """

    first: int
    second: int
    first_T_second: FloatArray
    covariance: FloatArray
    confirmed: bool = False

    def __post_init__(self) -> None:
        name = f"loop from {self.first} to {self.second}"
        checked_transform(f"{name}: first_T_second", self.first_T_second)
        P = checked(f"{name}: covariance", self.covariance, (6, 6))
        if np.abs(P - P.T).max() > 1e-6 * np.abs(P).max() or np.linalg.eigvalsh((P + P.T) / 2)[0] <= 0:
            raise InputError(f"{name}: covariance: expected a symmetric matrix, positive definite")


def loop_factors(
    loops: Sequence[LoopClosure], epochs: Sequence[int], robust: Robust | None
) -> list[gtsam.NonlinearFactor]:
    """Factors between the poses of `epochs`, by the numbers `first` and `second` of loops."""
    return [
        between_factor(
            pose_key(epochs[one.first]),
            pose_key(epochs[one.second]),
            one.first_T_second,
            one.covariance,
            None if one.confirmed else robust,
        )
        for one in loops
    ]


@dataclass(frozen=True, eq=False)
class Loops:
    """Provider of loops, without a loss; `epochs` are those of the poses by their numbers `first` and `second`.

    All come with the last of these epochs.
    """

    loops: Sequence[LoopClosure]
    epochs: Sequence[int]
    name: str = "loops"

    def factors(self, view: GraphView) -> Additions:
        last = max((self.epochs[end] for loop in self.loops for end in (loop.first, loop.second)), default=None)
        return Additions(factors=loop_factors(self.loops, self.epochs, None) if view.epoch == last else [])


_FALSE = 1e-3  # probability that a proven loop is false
_MAX_INFLATION = np.log(1e3)  # log of the largest inflation
_STARTS = (1.0, 3.0, 10.0, 30.0)  # inflations with which loops are chosen
_FIRST = PosePriors(np.zeros(1, dtype=np.int64), np.eye(4)[None], np.eye(6)[None])  # of the anchors, anywhere
_SIMPLEX = np.array([[0.0, 0.0], [0.7, 0.0], [0.0, 0.7]])
_MAX_CHOICES, _PRECISION = (
    12,
    {"xatol": 0.05, "fatol": 0.2, "maxfev": 40},
)  # of loops, that are fitted; of logarithms of inflations and their cost

Motion = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class LoopSelection:
    """kept (M,): which loops are true; inflation (2,): of odometry's deviations of rotation and translation, >= 1."""

    kept: BoolArray
    inflation: FloatArray

    def inflated(self, covariance: FloatArray) -> FloatArray:
        """A covariance (6, 6) of odometry."""
        scale = np.repeat(self.inflation, 3)
        return np.asarray(covariance * np.outer(scale, scale))


def drive_graph(steps: Sequence[Motion], loops: Sequence[LoopClosure], first: PosePriors) -> PoseGraph:
    """The graph of poses 0 .. n, at dead reckoning, with the motion from each to the next, and loops between them."""
    ends = [*pairwise(range(len(steps) + 1)), *((loop.first, loop.second) for loop in loops)]
    begin, end = np.array(ends, dtype=np.int64).reshape(-1, 2).T
    between = np.array([*(T for T, _ in steps), *(loop.first_T_second for loop in loops)]).reshape(-1, 4, 4)
    covariances = np.array([*(P for _, P in steps), *(loop.covariance for loop in loops)]).reshape(-1, 6, 6)
    ids, information = np.arange(len(steps) + 1, dtype=np.int64), _symmetric(np.linalg.inv(covariances))
    return PoseGraph.of_measurements(ids, begin, end, between, information, first)


def select_loops(motions: Sequence[Motion], anchors: Sequence[int], loops: Sequence[LoopClosure]) -> LoopSelection:
    """Judge loops between anchors, by their numbers; motions: from each keyframe to the next."""
    if not loops:
        return LoopSelection(np.ones(0, dtype=bool), np.ones(2))
    begin, end = min(loop.first for loop in loops), max(loop.second for loop in loops)
    steps = [_step(motions[a:b]) for a, b in pairwise(anchors[begin : end + 1])]
    drive = _AnchoredLoops.from_steps(
        steps, [replace(loop, first=loop.first - begin, second=loop.second - begin) for loop in loops]
    )
    choices = [(np.ones(len(loops), dtype=bool), np.ones(2))]
    choices += [(drive.agreeing(start), start) for start in np.outer(_STARTS, np.ones(2))]
    found: dict[bytes, LoopSelection] = {}
    costs: dict[bytes, float] = {}
    for kept, start in choices:
        if (name := kept.tobytes()) not in found:
            found[name], costs[name] = drive.fitted(kept, start)
            if len(choices) < _MAX_CHOICES:
                choices.append((drive.agreeing(found[name].inflation), found[name].inflation))
    return found[min(costs, key=costs.__getitem__)]


def _step(motions: Sequence[Motion]) -> Motion:
    """Odometry from an anchor to the next: the motion (4, 4), and (3, 6, 6) its covariance by rotations, by
    translations, and by both together."""
    total, parts = np.eye(4), np.zeros((3, 6, 6))
    for moved, P in motions:
        own = np.zeros((3, 6, 6))
        own[0, :3, :3], own[1, 3:, 3:] = P[:3, :3], P[3:, 3:]
        own[2] = P - own[0] - own[1]
        total, parts = total @ moved, carried_covariance(inverse_transform(moved), parts) + own
    return total, (parts + parts.swapaxes(1, 2)) / 2


@dataclass(frozen=True, eq=False)
class _AnchoredLoops:
    """measured: graph of the anchors, odometry's S steps before the loops; parts (S, 3, 6, 6) of their covariances."""

    measured: PoseGraph
    parts: FloatArray

    @classmethod
    def from_steps(cls, steps: Sequence[Motion], loops: Sequence[LoopClosure]) -> Self:
        parts = np.array([P for _, P in steps])
        return cls(drive_graph([(T, P.sum(axis=0)) for T, P in steps], loops, _FIRST), parts)

    def graph(self, inflation: FloatArray) -> PoseGraph:
        """The graph with odometry's deviations of rotation and of translation (2,) times as large."""
        a, b = inflation
        information = self.measured.information.copy()
        information[: len(self.parts)] = _symmetric(
            np.linalg.inv(np.einsum("g,sgij->sij", [a**2, b**2, a * b], self.parts))
        )
        return replace(self.measured, information=information)

    def agreeing(self, inflation: FloatArray) -> BoolArray:
        """The loops (M,) that agree with each other and with odometry so inflated."""
        return consensus(self.graph(inflation)).kept[len(self.parts) :]

    def fitted(self, kept: BoolArray, start: FloatArray) -> tuple[LoopSelection, float]:
        """The inflation with which some loops (M,) fit, and the cost of that with the others false."""
        solutions = [self.solved(kept, start, graph_values(self.measured))]

        def cost(logs: FloatArray) -> float:
            solutions.append(self.solved(kept, np.exp(logs), solutions.pop().values))
            return self.cost(solutions[0], kept, np.exp(logs))

        simplex = np.clip(np.log(start) + _SIMPLEX, 0.0, _MAX_INFLATION)
        options = {**_PRECISION, "initial_simplex": simplex}
        logs = minimize(cost, simplex[0], method="Nelder-Mead", bounds=[(0.0, _MAX_INFLATION)] * 2, options=options).x
        total = cost(logs) + self.false_cost(solutions[0], np.flatnonzero(~kept))
        return LoopSelection(kept, np.exp(logs)), total

    def solved(self, kept: BoolArray, inflation: FloatArray, start: gtsam.Values) -> Solution:
        """The anchors with some loops (M,)."""
        chosen = chosen_edges(self.graph(inflation), np.concatenate([np.ones(len(self.parts), dtype=bool), kept]))
        return solve(factor_graph(chosen), [], start, SOLVER)

    def cost(self, solution: Solution, kept: BoolArray, inflation: FloatArray) -> float:
        """The cost of the loops (M,) of a solution."""
        row, column, entry = solution.linear.sparseJacobian_()
        J = coo_array((entry, (row.astype(np.int64) - 1, column.astype(np.int64) - 1))).tocsc()[:, :-1]
        volume = float(np.log(np.abs(factorised(J.T @ J).U.diagonal())).sum())
        rows = np.concatenate([np.ones(len(self.parts), dtype=bool), kept])
        volume -= float(np.linalg.slogdet(self.graph(inflation).information[rows])[1].sum())
        return 2 * solution.error + volume + 2 * float(np.log(inflation).sum())

    def false_cost(self, solution: Solution, rows: IntArray) -> float:
        """The cost of some loops (n,) besides, false, by a solution without them."""
        first, second = (ends[len(self.parts) + rows] for ends in (self.measured.first, self.measured.second))
        keys, total = np.unique([first, second]), 0.0
        P = solution.covariance(keys.tolist()) if len(rows) else np.empty((0, 0))
        for row, a, b in zip((len(self.parts) + rows).tolist(), first.tolist(), second.tolist(), strict=True):
            between = solution.values.atPose3(a).between(solution.values.atPose3(b))
            v = gtsam.Pose3(self.measured.first_T_second[row]).localCoordinates(between)
            G = np.hstack([-between.inverse().AdjointMap(), np.eye(6)])
            at = np.concatenate([6 * np.searchsorted(keys, end) + np.arange(6) for end in (a, b)])
            V = G @ P[np.ix_(at, at)] @ G.T + np.linalg.inv(self.measured.information[row])
            more = np.maximum((v**2 - np.diag(V)).reshape(2, 3).mean(axis=1), 0.0)
            V = V + np.diag(np.repeat(more, 3))
            total += float(v @ np.linalg.solve(V, v) + np.linalg.slogdet(V)[1]) - 2 * np.log(_FALSE)
        return total


def _symmetric(matrices: FloatArray) -> FloatArray:
    return np.asarray((matrices + matrices.swapaxes(1, 2)) / 2)

"""Loops between submaps: their factors, how they disagree with dead reckoning, and which are true.

What loops say against dead reckoning, as a sparse linear system over the anchors.

d_j, the error of the anchor j in its own frame (d_0 = 0), takes the place of the errors of odometry's steps,

    e_j = d_(j+1) - A_j d_j,  A_j = Ad(T_(j+1)^-1 T_j)        r_k = m_k + d_b - B_k d_a,  B_k = Ad(T_b^-1 T_a)

so that steps and loops are edges of one graph, H = sum G^T W G over both. With e = r = the residuals at its solution

    m^T C^-1 m  = sum e^T Q^-1 e + sum r^T R^-1 r         log |C| = log |H| + log |Q| + log |R|

where C = J Q J^T + R is the covariance of all loops by odometry, which is dense wherever cycles overlap. H is factored
by sparse LU without pivoting.

Which loops between submaps are true, and how far odometry is off its own noise, once a drive is over.

A loop that passed its proof is false with probability `_FALSE` only. Odometry alone never speaks against it: the
deviations of odometry's rotation and translation are s_1 and s_2 >= 1 times those stated, as the loops have it. With
what the loops K say against dead reckoning, m_K, linearised at their solution,

    cost(K) = min_s ( m_K^T C_K^-1 m_K + log |C_K| + 2 log s_1 s_2 ),      C = J Q(s) J^T + R

is -2 log of their likelihood. Q(s): inflated covariance of odometry, J: the loops by odometry's steps, R: their own
covariance; the prior of s is 1 / s. A false loop has errors of rotation and of translation of its own besides: with
what K predicts of it, v with covariance V, it costs

    min_t ( v^T V_t^-1 v + log |V_t| ) - 2 log `_FALSE`,      V_t = V + diag(t_1^2 1, t_2^2 1)

Loops leave or return while the sum falls, once from all of them, once from the one that fits odometry best; the cheaper
end is taken. So a loop alone stays, and several that agree at some s.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, pairwise
from typing import Any

import gtsam
import numpy as np
from scipy.optimize import minimize
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import splu

from factors import Robust, between_factor
from saga_fg.errors import InputError
from saga_fg.graph import Additions, GraphView
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, checked
from saga_fg.numerics.geometry import carried_covariance, checked_transform, inverse_transform
from saga_fg.slam.mapping import pose_key


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
    """Provider of loops, without a loss; `epochs` are those of the poses by their numbers `first` and `second`."""

    loops: Sequence[LoopClosure]
    epochs: Sequence[int]
    name: str = "loops"
    _by_epoch: dict[int, list[LoopClosure]] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        for loop in self.loops:
            later = max(self.epochs[loop.first], self.epochs[loop.second])
            self._by_epoch.setdefault(later, []).append(loop)

    def factors(self, view: GraphView) -> Additions:
        return Additions(factors=loop_factors(self._by_epoch.get(view.epoch, ()), self.epochs, None))


_AT_ONCE = 64  # loops predicted


@dataclass(frozen=True, eq=False)
class Misfits:
    """M loops between S + 1 anchors, linearised.

    m       (M, 6) deviations of loops from dead reckoning; ends (M, 2) their anchors
    turned  (M, 6, 6) B of each loop; moved (S, 6, 6) A of each step
    parts   (S, 3, 6, 6) covariance of each step by rotations, by translations, and by both together
    R       (M, 6, 6) covariance of each loop
    """

    m: FloatArray
    ends: IntArray
    turned: FloatArray
    moved: FloatArray
    parts: FloatArray
    R: FloatArray

    def loops(self, kept: BoolArray) -> tuple[csc_array, FloatArray, float]:
        """What kept loops add to H, its right side (S, 6), and log |R|; the same for every inflation."""
        W = np.asarray(np.linalg.inv(self.R[kept]))
        H = _assembled(len(self.moved), self.ends[kept], self.turned[kept], W)
        side = np.zeros((len(self.moved) + 1, 6))
        weighted = np.einsum("kij,kj->ki", W, self.m[kept])
        np.add.at(side, self.ends[kept, 1], -weighted)
        np.add.at(side, self.ends[kept, 0], np.einsum("kij,ki->kj", self.turned[kept], weighted))
        return H, side[1:], float(np.linalg.slogdet(self.R[kept])[1].sum())

    def solved(self, kept: BoolArray, inflation: FloatArray, loops: tuple[csc_array, FloatArray, float]) -> Solution:
        """The errors of anchors by kept loops, of which `loops` says what they add, with inflated odometry."""
        Q = np.einsum("g,sgij->sij", _scales(inflation), self.parts)
        inverse = np.linalg.inv(Q)
        steps = len(self.moved)
        chain = np.column_stack([np.arange(steps), np.arange(1, steps + 1)])
        H = _assembled(steps, chain, self.moved, inverse) + loops[0]
        factor = splu(H.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        d = np.concatenate([np.zeros((1, 6)), factor.solve(loops[1].ravel()).reshape(-1, 6)])
        e = d[1:] - np.einsum("sij,sj->si", self.moved, d[:-1])
        r = self.m + d[self.ends[:, 1]] - np.einsum("kij,kj->ki", self.turned, d[self.ends[:, 0]])
        squares = np.einsum("si,sij,sj->", e, inverse, e)
        squares += (r[kept] * np.linalg.solve(self.R[kept], r[kept][..., None])[..., 0]).sum()
        volume = np.log(np.abs(factor.U.diagonal())).sum() + np.linalg.slogdet(Q)[1].sum() + loops[2]
        return Solution(self, factor, e, r, float(squares + volume))


@dataclass(frozen=True, eq=False)
class Solution:
    """errors (S, 6) of odometry's steps and residuals (M, 6) of all loops; cost: m^T C^-1 m + log |C| of those kept."""

    misfits: Misfits
    factor: Any
    errors: FloatArray
    residuals: FloatArray
    cost: float

    def predicted(self, rows: IntArray) -> FloatArray:
        """The covariances (n, 6, 6) with which the solution predicts some loops."""
        given = self.misfits
        P, size = np.empty((len(rows), 6, 6)), 6 * len(given.moved)
        for part in range(0, len(rows), _AT_ONCE):
            at = rows[part : part + _AT_ONCE]
            side = np.zeros((len(given.moved) + 1, 6, len(at), 6))
            each = np.arange(len(at))
            side[given.ends[at, 1], :, each] = np.eye(6)
            side[given.ends[at, 0], :, each] = -given.turned[at].swapaxes(1, 2)
            x = self.factor.solve(side[1:].reshape(size, -1)).reshape(-1, 6, len(at), 6)
            x = np.concatenate([np.zeros((1, *x.shape[1:])), x])
            P[part : part + _AT_ONCE] = x[given.ends[at, 1], :, each] - given.turned[at] @ x[given.ends[at, 0], :, each]
        return (P + P.swapaxes(1, 2)) / 2

    def left_out(self, rows: IntArray, kept: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Deviations v (n, 6) and covariances V (n, 6, 6) of some loops by the kept ones without them."""
        P, R, v = self.predicted(rows), self.misfits.R[rows], self.residuals[rows]
        V, inside = P + R, kept[rows]
        if inside.any():
            inverse = np.linalg.inv(R[inside])
            V[inside] = np.linalg.inv(inverse - inverse @ P[inside] @ inverse)
            v = v.copy()
            v[inside] = np.einsum("kij,kjl,kl->ki", V[inside], inverse, v[inside])
        return v, V


def _assembled(steps: int, ends: IntArray, turned: FloatArray, W: FloatArray) -> csc_array:
    """The sum of G^T W G (6S, 6S) over edges (n, 2), whose residuals are d_b - turned d_a; d_0 is fixed."""
    across = -W @ turned
    blocks = np.stack([W, across, across.swapaxes(1, 2), -turned.swapaxes(1, 2) @ across], axis=1)
    block = ends[:, [1, 1, 0, 0]] - 1, ends[:, [1, 0, 1, 0]] - 1
    free = (block[0] >= 0) & (block[1] >= 0)
    row, column = (6 * at[free][:, None, None] for at in block)
    row, column = np.broadcast_arrays(row + np.arange(6)[:, None], column + np.arange(6))
    entries = blocks[free].ravel(), (row.ravel(), column.ravel())
    return coo_array(entries, shape=(6 * steps, 6 * steps)).tocsc()


def _scales(inflation: FloatArray) -> FloatArray:
    a, b = inflation
    return np.array([a**2, b**2, a * b])


_FALSE = 1e-3  # probability that a proven loop is false
_MOST = np.log(1e3)  # log of the largest inflation
_STARTS = np.ones(2), np.full(2, 10.0)  # inflations
_TRIED, _FITTED = 5, 2  # loops whose leaving is tried, the worst first, and choices whose inflation is fitted
_STEPS, _SETTLED = 10, 1e-4
_NUDGE, _PRECISION = 1e-3, {"ftol": 1e-7, "gtol": 1e-3}  # of logarithms of inflations, for slopes; of their fit
_LOG = logging.getLogger(__name__)

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


def select_loops(motions: Sequence[Motion], anchors: Sequence[int], loops: Sequence[LoopClosure]) -> LoopSelection:
    """Judge loops between anchors, by their numbers; motions: from each keyframe to the next."""
    if not loops:
        return LoopSelection(np.ones(0, dtype=bool), np.ones(2))
    begin, end = min(loop.first for loop in loops), max(loop.second for loop in loops)
    steps = [_step(motions[a:b]) for a, b in pairwise(anchors[begin : end + 1])]
    loops = [replace(loop, first=loop.first - begin, second=loop.second - begin) for loop in loops]
    problem = _Problem(np.array([T for T, _ in steps]), np.array([parts for _, parts in steps]), loops)
    everyone = _searched(problem, np.ones(len(loops), dtype=bool))
    if everyone.kept.all() and np.isclose(everyone.inflation, 1.0).all():
        return LoopSelection(everyone.kept, everyone.inflation)
    misfits, none = problem.at(np.zeros((len(steps), 6))), np.zeros(len(loops), dtype=bool)
    dead_reckoning = misfits.solved(none, np.ones(2), misfits.loops(none))
    alone = _judged(dead_reckoning, none, np.arange(len(loops)))[0]
    one = _searched(problem, np.arange(len(loops)) == int(np.argmin(alone)))
    best = min(everyone, one, key=lambda found: found.cost)
    return LoopSelection(best.kept, best.inflation)


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
class _Found:
    """Loops (M,), the inflation (2,) with which they fit, their cost, and the solution with them."""

    kept: BoolArray
    inflation: FloatArray
    cost: float
    solution: Solution


@dataclass(frozen=True, eq=False)
class _Problem:
    """Steps of odometry (S, 4, 4), the parts of their covariances (S, 3, 6, 6), and the loops."""

    steps: FloatArray
    parts: FloatArray
    loops: Sequence[LoopClosure]

    def at(self, errors: FloatArray) -> Misfits:
        """Linearised where odometry's steps are off by errors (S, 6)."""
        steps = [gtsam.Pose3(T).retract(error) for T, error in zip(self.steps, errors, strict=True)]
        poses = list(accumulate(steps, lambda pose, step: pose.compose(step), initial=gtsam.Pose3()))
        ends = np.array([(loop.first, loop.second) for loop in self.loops])
        between = [poses[a].between(poses[b]) for a, b in ends.tolist()]
        r = [gtsam.Pose3(loop.first_T_second).localCoordinates(T) for loop, T in zip(self.loops, between, strict=True)]
        moved, turned = (np.array([T.inverse().AdjointMap() for T in each]) for each in (steps, between))
        d = np.zeros((len(poses), 6))
        for j, error in enumerate(errors):
            d[j + 1] = moved[j] @ d[j] + error
        m = np.array(r) - d[ends[:, 1]] + np.einsum("kij,kj->ki", turned, d[ends[:, 0]])
        return Misfits(m, ends, turned, moved, self.parts, np.array([loop.covariance for loop in self.loops]))

    def solved(self, found: _Found) -> tuple[Misfits, _Found]:
        """Linearised at the solution of some of the loops, with the inflation that fits there."""
        errors = np.zeros((len(self.steps), 6))
        misfits = self.at(errors)
        found = _fitted(misfits, found.kept, [found.inflation])
        for _ in range(_STEPS):
            before, errors = errors, found.solution.errors
            misfits = self.at(errors)
            found = _fitted(misfits, found.kept, [found.inflation])
            if np.abs(errors - before).max() < _SETTLED:
                break
        return misfits, found


def _costed(misfits: Misfits, kept: BoolArray, inflation: FloatArray) -> _Found:
    """Loops (M,) with some inflation, as it is."""
    solution = misfits.solved(kept, inflation, misfits.loops(kept))
    false = _judged(solution, kept, np.flatnonzero(~kept))[1].sum()
    return _Found(kept, inflation, float(solution.cost + 2 * np.log(inflation).sum() + false), solution)


def _fitted(misfits: Misfits, kept: BoolArray, starts: Sequence[FloatArray]) -> _Found:
    """The inflation with which loops (M,) fit, from one or several."""
    loops = misfits.loops(kept)

    def cost(logs: FloatArray) -> float:
        return misfits.solved(kept, np.exp(logs), loops).cost + 2 * float(logs.sum())

    def slopes(logs: FloatArray) -> FloatArray:
        return np.array([cost(logs + step) - cost(logs - step) for step in _NUDGE * np.eye(2)]) / (2 * _NUDGE)

    ends = [
        minimize(cost, np.log(x), jac=slopes, method="L-BFGS-B", bounds=[(0.0, _MOST)] * 2, options=_PRECISION)
        for x in starts
    ]
    return _costed(misfits, kept, np.exp(min(ends, key=lambda end: float(end.fun)).x))


def _judged(solution: Solution, kept: BoolArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
    """Costs (n,) of some loops by the kept ones without them: if they are true, and if they are false."""
    v, V = solution.left_out(rows, kept)
    squares = (v**2 - np.diagonal(V, axis1=1, axis2=2)).reshape(-1, 2, 3).mean(axis=2)
    more = np.repeat(np.maximum(squares, 0.0), 3, axis=1)  # covariance of further errors, by moments
    return _cost(v, V), _cost(v, V + more[:, None] * np.eye(6)) - 2 * np.log(_FALSE)


def _searched(problem: _Problem, kept: BoolArray) -> _Found:
    """Loops leave and return while the cost falls."""
    misfits, found = problem.solved(_fitted(problem.at(np.zeros((len(problem.steps), 6))), kept, _STARTS))
    for _ in range(4 * len(kept)):
        better = _better(misfits, found)
        if better is None:
            return found
        misfits, found = problem.solved(better)
    _LOG.warning("the choice among %d loops has not settled: the last one is taken", len(kept))
    return found


def _better(misfits: Misfits, found: _Found) -> _Found | None:
    """The cheapest of the choices next to this one, if it is cheaper: those that agree return, or the worst leave."""
    kept = found.kept
    true, false = _judged(found.solution, kept, np.arange(len(kept)))
    score = true - false
    returning = np.flatnonzero(~kept & (score < 0))
    returning, tried = returning[np.argsort(score[returning], kind="stable")], []
    while len(returning) > 1:  # the best half of them, and so on
        tried.append(kept | np.isin(np.arange(len(kept)), returning))
        returning = returning[: len(returning) // 2]
    leaving = kept & (score > max(score[kept].max() / 2, 0.0))
    tried += [kept & ~leaving] if leaving.sum() > 1 else []
    for group in (np.flatnonzero(~kept), np.flatnonzero(kept)[::-1]):
        inside = bool(len(group) and kept[group[0]])
        order = group[np.argsort(-score[group] if inside else score[group], kind="stable")][:_TRIED]
        tried += [kept ^ (np.arange(len(score)) == row) for row in order]
    guesses = [found.inflation**share for share in (1.0, 0.5, 0.0)[: 1 if (found.inflation == 1).all() else 3]]
    rough = [[_costed(misfits, choice, guess) for guess in guesses] for choice in tried if choice.any()]
    chosen = sorted((min(costs, key=_by_cost) for costs in rough), key=_by_cost)[:_FITTED]
    best = min((_fitted(misfits, one.kept, [one.inflation]) for one in chosen), key=_by_cost, default=found)
    return best if best.cost < found.cost - 1e-3 else None


def _by_cost(found: _Found) -> float:
    return found.cost


def _cost(v: FloatArray, V: FloatArray) -> FloatArray:
    return np.asarray((v * np.linalg.solve(V, v[..., None])[..., 0]).sum(axis=1) + np.linalg.slogdet(V)[1])

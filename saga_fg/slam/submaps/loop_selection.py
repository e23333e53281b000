"""Which loops between submaps are true, and how far odometry is off its own noise, once a drive is over.

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
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise

import gtsam
import numpy as np
from scipy.optimize import minimize

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.geometry import carried_covariance, inverse_transform
from saga_fg.slam.submaps.loop_misfits import Misfits, Solution
from saga_fg.slam.submaps.loops import LoopClosure

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

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
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.slam.submaps.loops import LoopClosure

_FALSE = 1e-3  # probability that a proven loop is false
_MOST = np.log(1e3)  # log of the largest inflation
_STARTS = (0.0, np.log(10.0))
_TRIED = 5  # loops whose leaving is tried, the worst first
_STEPS, _SETTLED = 10, 1e-4
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
    steps = [_step(motions[a:b]) for a, b in pairwise(anchors)]
    problem = _Problem(np.array([T for T, _ in steps]), np.array([parts for _, parts in steps]), loops)
    everyone = _searched(problem, np.ones(len(loops), dtype=bool))
    if everyone.kept.all() and np.isclose(everyone.inflation, 1.0).all():
        return LoopSelection(everyone.kept, everyone.inflation)
    alone = problem.at(np.zeros((len(steps), 6))).alone()
    one = _searched(problem, np.arange(len(loops)) == int(np.argmin(alone)))
    best = min(everyone, one, key=lambda found: found.cost)
    return LoopSelection(best.kept, best.inflation)


def _step(motions: Sequence[Motion]) -> Motion:
    """Odometry from an anchor to the next: the motion (4, 4), and (3, 6, 6) its covariance by rotations, by
    translations, and by both together."""
    total, parts = np.eye(4), np.zeros((3, 6, 6))
    for moved, P in motions:
        Ad = gtsam.Pose3(moved).inverse().AdjointMap()
        own = np.zeros((3, 6, 6))
        own[0, :3, :3], own[1, 3:, 3:] = P[:3, :3], P[3:, 3:]
        own[2] = P - own[0] - own[1]
        total, parts = total @ moved, Ad @ parts @ Ad.T + own
    return total, (parts + parts.swapaxes(1, 2)) / 2


@dataclass(frozen=True, eq=False)
class _Found:
    """Loops (M,), the inflation (2,) with which they fit, and their cost."""

    kept: BoolArray
    inflation: FloatArray
    cost: float


@dataclass(frozen=True, eq=False)
class _Problem:
    """Steps of odometry (S, 4, 4), the parts of their covariances (S, 3, 6, 6), and the loops."""

    steps: FloatArray
    parts: FloatArray
    loops: Sequence[LoopClosure]

    def at(self, errors: FloatArray) -> _Misfits:
        """Linearised where odometry's steps are off by errors (S, 6)."""
        poses = [gtsam.Pose3()]
        for T, error in zip(self.steps, errors, strict=True):
            poses.append(poses[-1].compose(gtsam.Pose3(T).retract(error)))
        own = np.array([pose.AdjointMap() for pose in poses])
        J = np.zeros((len(self.loops), 6, len(self.steps), 6))
        m = np.empty((len(self.loops), 6))
        for row, loop in enumerate(self.loops):
            a, b = loop.first, loop.second
            J[row, :, a:b] = (np.linalg.inv(own[b]) @ own[a + 1 : b + 1]).swapaxes(0, 1)
            r = gtsam.Pose3(loop.first_T_second).localCoordinates(poses[a].between(poses[b]))
            m[row] = r - np.einsum("isj,sj->i", J[row], errors)
        size, flat = 6 * len(self.loops), J.reshape(6 * len(self.loops), -1)
        spread = [np.einsum("asj,sjk->ask", J.reshape(size, -1, 6), self.parts[:, g]) for g in range(3)]
        C = np.array([part.reshape(size, -1) @ flat.T for part in spread])
        R = np.zeros((size, size))
        for row, loop in enumerate(self.loops):
            R[6 * row : 6 * row + 6, 6 * row : 6 * row + 6] = loop.covariance
        return _Misfits(m.ravel(), C, R, np.array([part.reshape(size, -1) for part in spread]))

    def solved(self, found: _Found) -> tuple[_Misfits, _Found]:
        """Linearised at the solution of some of the loops, with the inflation that fits there."""
        errors = np.zeros((len(self.steps), 6))
        misfits = self.at(errors)
        for _ in range(_STEPS):
            before, errors = errors, misfits.errors(found).reshape(-1, 6)
            misfits = self.at(errors)
            found = misfits.fitted(found.kept, found.inflation)
            if np.abs(errors - before).max() < _SETTLED:
                break
        return misfits, found


@dataclass(frozen=True, eq=False)
class _Misfits:
    """m (6M,) of all loops; C (3, 6M, 6M): their covariance by parts of odometry's; R (6M, 6M): by the loops' own;
    spread (3, 6M, 6S): with odometry's errors."""

    m: FloatArray
    C: FloatArray
    R: FloatArray
    spread: FloatArray

    def covariance(self, inflation: FloatArray, rows: IntArray) -> FloatArray:
        parts = np.ix_(rows, rows)
        return np.asarray(np.tensordot(_scales(inflation), [C[parts] for C in self.C], 1) + self.R[parts])

    def fitted(self, kept: BoolArray, start: FloatArray | None = None) -> _Found:
        """The inflation with which loops (M,) fit, from some inflation, or from several."""
        rows = _rows(kept)
        C, R, m = [part[np.ix_(rows, rows)] for part in self.C], self.R[np.ix_(rows, rows)], self.m[rows]

        def cost(logs: FloatArray) -> tuple[float, FloatArray]:
            a, b = s = np.exp(logs)
            factor = cho_factor(np.tensordot(_scales(s), C, 1) + R)
            x, inverse = cho_solve(factor, m), cho_solve(factor, np.eye(len(m)))
            slopes = [(inverse * D).sum() - x @ D @ x for D in C]
            own = np.array([2 * a**2 * slopes[0], 2 * b**2 * slopes[1]]) + a * b * slopes[2]
            return float(m @ x + 2 * np.log(np.diag(factor[0])).sum() + 2 * logs.sum()), own + 2

        begin = [np.full(2, x) for x in _STARTS] if start is None else [np.log(start)]
        ends = [minimize(cost, x, jac=True, method="L-BFGS-B", bounds=[(0.0, _MOST)] * 2) for x in begin]
        best = min(ends, key=lambda end: float(end.fun))
        inflation = np.exp(best.x)
        return _Found(kept, inflation, float(best.fun) + float(self.judged(kept, inflation)[1][~kept].sum()))

    def alone(self) -> FloatArray:
        """-2 log likelihood (M,) of each loop by odometry as it is stated."""
        C = self.covariance(np.ones(2), np.arange(len(self.m)))
        own = [slice(row, row + 6) for row in range(0, len(self.m), 6)]
        return np.array([_cost(self.m[at], C[at, at]) for at in own])

    def errors(self, found: _Found) -> FloatArray:
        """Errors (6S,) of odometry's steps by these loops."""
        rows = _rows(found.kept)
        x = np.linalg.solve(self.covariance(found.inflation, rows), self.m[rows])
        return np.asarray(-np.tensordot(_scales(found.inflation), self.spread[:, rows], 1).T @ x)

    def judged(self, kept: BoolArray, inflation: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Costs (M,) of each loop by the kept ones without it: if it is true, and if it is false."""
        rows = _rows(kept)
        C = self.covariance(inflation, np.arange(len(self.m)))
        inverse = np.linalg.inv(C[np.ix_(rows, rows)])
        x = inverse @ self.m[rows]
        place = {row: 6 * n for n, row in enumerate(np.flatnonzero(kept).tolist())}
        costs = np.empty((2, len(kept)))
        for row in range(len(kept)):
            own = slice(6 * row, 6 * row + 6)
            if row in place:
                at = slice(place[row], place[row] + 6)
                V = np.linalg.inv(inverse[at, at])
                v = V @ x[at]
            else:
                across = C[own][:, rows]
                V, v = C[own, own] - across @ inverse @ across.T, self.m[own] - across @ x
            costs[:, row] = _cost(v, V), _cost(v, V + _more(v, V)) - 2 * np.log(_FALSE)
        return costs[0], costs[1]


def _searched(problem: _Problem, kept: BoolArray) -> _Found:
    """Loops leave and return while the cost falls."""
    misfits, found = problem.solved(problem.at(np.zeros((len(problem.steps), 6))).fitted(kept))
    for _ in range(4 * len(kept)):
        better = _better(misfits, found)
        if better is None:
            return found
        misfits, found = problem.solved(better)
    _LOG.warning("the choice among %d loops has not settled: the last one is taken", len(kept))
    return found


def _better(misfits: _Misfits, found: _Found) -> _Found | None:
    """The cheapest of the choices next to this one, if it is cheaper: those that agree return, or the worst leaves."""
    true, false = misfits.judged(found.kept, found.inflation)
    score = true - false
    agreeing = ~found.kept & (score < 0)
    tried = [found.kept | agreeing] if agreeing.sum() > 1 else []
    for group in (np.flatnonzero(~found.kept), np.flatnonzero(found.kept)[::-1]):
        inside = bool(len(group) and found.kept[group[0]])
        order = group[np.argsort(-score[group] if inside else score[group], kind="stable")][:_TRIED]
        tried += [found.kept ^ (np.arange(len(score)) == row) for row in order]
    choices = [misfits.fitted(kept) for kept in tried if kept.any()]
    best = min(choices, key=lambda choice: choice.cost, default=found)
    return best if best.cost < found.cost - 1e-3 else None


def _cost(v: FloatArray, V: FloatArray) -> float:
    return float(v @ np.linalg.solve(V, v) + np.linalg.slogdet(V)[1])


def _more(v: FloatArray, V: FloatArray) -> FloatArray:
    """The covariance (6, 6) of further errors of rotation and of translation, by moments."""
    squares = (v**2 - np.diag(V)).reshape(2, 3).mean(axis=1)
    return np.diag(np.repeat(np.maximum(squares, 0.0), 3))


def _rows(kept: BoolArray) -> IntArray:
    return np.flatnonzero(np.repeat(kept, 6))


def _scales(inflation: FloatArray) -> FloatArray:
    a, b = inflation
    return np.array([a**2, b**2, a * b])

"""A closed submap as one factor between its anchor and the next one.

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
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from factors import Variable, between_factor, residual_factor
from saga_fg.graph import Factor, LinearisationPoint, PriorGroup, stacked
from saga_fg.numerics import FloatArray

_NOTHING = 1e-3  # root of the information that counts as none: a deviation of 1000 m or rad


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
        if for_all_time or np.abs(columns[:, :6]).max(initial=0.0) >= _NOTHING:
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
    rank = int((s > _NOTHING).sum())
    rows: FloatArray = U[:, rank:].T @ J[:, [*mine, J.shape[1] - 1]]
    return rows


def _compressed(J: FloatArray) -> tuple[FloatArray, FloatArray]:
    """W and c with || W y - c || = || J y - b || but for a constant; J: [J | b]."""
    U, s, Vt = np.linalg.svd(J[:, :-1], full_matrices=False)
    kept = s > _NOTHING
    return s[kept, None] * Vt[kept], U[:, kept].T @ J[:, -1]

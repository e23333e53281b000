"""A closed submap as one factor between its anchor and the next one.

The variables of the submap are eliminated; the marginal that they leave on the two anchors A and B is a Gaussian on
increments. In the coordinates

    y = ( log(A_0^-1 A),  log(R_0^-1 A^-1 B) ),        R_0 = A_0^-1 B_0

the second part does not change when both anchors move as one, as they do when a loop closes far away. Factors that
speak of relative poses alone, odometry and walls, leave rows on this part only, and become a measured motion. What
refers to the world (positions by GPS, the vertical) leaves rows on the first part too; then || W y - c || is a factor
as it is. After G. Grisetti, R. Kuemmerle, K. Ni, "Robust optimization of factor graphs by using condensed
measurements", IROS 2012.

The graph that goes on has B with what is known of it by everything before, A eliminated too: a prior. Variables for all
time (calibrations) are in that prior with B; between anchors they count as unknown. Variables of the newest epoch that
go on (velocity, bias) keep their own marginal: their correlation with the motion before is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np

from factors import SpatialPose, Variable, between_factor, pose_prior_factor, residual_factor
from saga_fg.graph.factor_checks import Factor, stacked
from saga_fg.graph.factor_groups import PriorGroup
from saga_fg.graph.variables import LinearisationPoint
from saga_fg.numerics.arrays import FloatArray

_NOTHING = 1e-3  # root of the information that counts as none: a deviation of 1000 m or rad


@dataclass(eq=False)
class CondensedSubmap:
    """Closes a submap; anchor, successor: keys of its two poses; named: what these are called in the graph of anchors.

    between  factors of that graph, once the submap is closed; others: what goes on in the running graph besides the
             prior of the successor
    """

    anchor: int
    successor: int
    named: tuple[int, int]
    name: str = "submaps"
    between: list[Factor] = field(default_factory=list, init=False)
    others: list[Factor] = field(default_factory=list, init=False)

    def factors(
        self,
        marginal: Sequence[gtsam.JacobianFactor],
        earlier: Sequence[gtsam.JacobianFactor],
        point: LinearisationPoint,
    ) -> list[Factor]:
        self.between = self._between(*_stacked(marginal, point, (self.anchor, self.successor)), point)
        keys, J = _stacked([*marginal, *earlier], point, (self.anchor, self.successor))
        others = [key for key in keys if key not in (self.anchor, self.successor)]
        gone_on = [key for key in others if point.variables[key].epoch is not None]
        for_all_time = [key for key in others if key not in gone_on]
        own = [_factor_on(chosen, _marginal(keys, J, chosen, point), point) for chosen in (gone_on, for_all_time)]
        self.others = [factor for made in own for factor in made]
        if for_all_time:
            joint = [self.successor, *for_all_time]
            return [*own[0], *_factor_on(joint, _marginal(keys, J, joint, point), point)]
        W, c = _compressed(_marginal(keys, J, [self.successor], point))
        if len(c) < 6:
            return [*own[0], *_factor_on([self.successor], _marginal(keys, J, [self.successor], point), point)]
        root = np.linalg.inv(W)
        here = _pose(point, self.successor).retract(root @ c).matrix()
        return [*own[0], pose_prior_factor(self.successor, here, root @ root.T)]

    def _between(self, keys: list[int], J: FloatArray, point: LinearisationPoint) -> list[Factor]:
        """Factors on the two poses under their names in the graph of anchors."""
        J = _marginal(keys, J, (self.anchor, self.successor), point)
        rel = _pose(point, self.anchor).between(_pose(point, self.successor))
        Ad = rel.inverse().AdjointMap()
        columns = J.copy()
        columns[:, :6] += J[:, 6:12] @ Ad  # of y: d(B) = d(rel) + Ad d(A)
        if np.abs(columns[:, :6]).max(initial=0.0) < _NOTHING:
            R = np.linalg.qr(columns[:, 6:])[1]
            step = np.linalg.solve(R[:6, :6], R[:6, 6])
            root = np.linalg.inv(R[:6, :6])
            return [between_factor(*self.named, rel.retract(step).matrix(), root @ root.T)]
        W, c = _compressed(columns)
        factor = _Condensed(_pose(point, self.anchor), rel, W, c)
        kinds = (SpatialPose(), SpatialPose())
        return [residual_factor(self.named, kinds, factor.residual, np.eye(len(c)), factor.jacobians, name="submap")]


@dataclass(frozen=True, eq=False)
class _Condensed:
    """W y - c."""

    anchor: gtsam.Pose3
    rel: gtsam.Pose3
    W: FloatArray
    c: FloatArray

    def residual(self, A: gtsam.Pose3, B: gtsam.Pose3) -> FloatArray:
        y = [self.anchor.localCoordinates(A), self.rel.localCoordinates(A.between(B))]
        return np.asarray(self.W @ np.concatenate(y) - self.c)

    def jacobians(self, A: gtsam.Pose3, B: gtsam.Pose3) -> list[FloatArray]:
        rel = A.between(B)
        absolute = gtsam.Pose3.LogmapDerivative(self.anchor.between(A))
        relative = gtsam.Pose3.LogmapDerivative(self.rel.between(rel))
        by_a = self.W[:, :6] @ absolute - self.W[:, 6:] @ relative @ rel.inverse().AdjointMap()
        return [by_a, self.W[:, 6:] @ relative]


def _pose(point: LinearisationPoint, key: int) -> gtsam.Pose3:
    return point.values.atPose3(key)


def _stacked(
    marginal: Sequence[gtsam.JacobianFactor], point: LinearisationPoint, first: Sequence[int]
) -> tuple[list[int], FloatArray]:
    """Keys, `first` in front, and all rows [J | b] on increments from the point."""
    priors = [PriorGroup(stacked([factor], point.dims(factor.keys()))) for factor in marginal]
    here = [factor for prior in priors for factor in prior.here(np.array([0]), point)]
    found = {key for factor in here for key in factor.keys()}  # noqa: SIM118
    keys = [*(key for key in first if key in found), *sorted(found.difference(first))]
    ends = dict(zip(keys, np.cumsum(point.dims(keys)).tolist(), strict=True))
    rows = []
    for factor in here:
        augmented = factor.augmentedJacobian()
        row, column = np.zeros((len(augmented), sum(point.dims(keys)) + 1)), 0
        row[:, -1] = augmented[:, -1]
        for key in factor.keys():  # noqa: SIM118
            d = point.variables[key].dim
            row[:, ends[key] - d : ends[key]] = augmented[:, column : column + d]
            column += d
        rows.append(row)
    return keys, np.concatenate(rows) if rows else np.empty((0, 1))


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


def _factor_on(keys: Sequence[int], J: FloatArray, point: LinearisationPoint) -> list[Factor]:
    """A factor of rows [J | b] on increments of some variables from where they are."""
    W, c = _compressed(J)
    if not len(c):
        return []
    types = tuple(point.variables[key].type for key in keys)
    states = tuple(kind.read(point.values, key) for kind, key in zip(types, keys, strict=True))
    return [residual_factor(tuple(keys), types, _Held(types, states, W, c).residual, np.eye(len(c)), name="submap")]


@dataclass(frozen=True, eq=False)
class _Held:
    """W y - c of increments from some states."""

    types: tuple[Variable, ...]
    states: tuple[Any, ...]
    W: FloatArray
    c: FloatArray

    def residual(self, *now: Any) -> FloatArray:
        y = [kind.local(at, x) for kind, at, x in zip(self.types, self.states, now, strict=True)]
        return np.asarray(self.W @ np.concatenate(y) - self.c)

r"""Graduated non-convexity: robust estimation that does not depend on where it starts.

A robust loss that rejects outliers altogether has many local minima. It is reached from a convex surrogate with a
parameter mu; between two steps of mu the problem is solved with fixed weights, s being the distance of a residual in
standard deviations and c the largest that an inlier may have:

    geman-mcclure   w = ( mu c^2 / (s^2 + mu c^2) )^2          mu from 2 s_max^2 / c^2 down to 1, by 1.4
    truncated       w = 1                    s^2 <= mu/(mu+1) c^2
                        0                    s^2 >= (mu+1)/mu c^2       mu from c^2 / (2 s_max^2 - c^2) up, by 1.4,
                        c/s sqrt(mu(mu+1)) - mu  in between              until every weight is 0 or 1

Factors with such a loss (`robust=`) are reached so by `saga_fg.estimators.BatchSolver`, while other solvers take the
loss itself, mu at its end.

Source: Yang, Antonante, Tzoumas, Carlone, Graduated Non-Convexity for Robust Spatial Perception, RA-L 2020.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors import Solution, SolverSettings, solve
from saga_fg.errors import InputError
from saga_fg.graph.factor_groups import ActiveRows, ResidualGroup
from saga_fg.numerics.arrays import FloatArray
from saga_fg.settings import setting

log = logging.getLogger(__name__)

Loss = Literal["truncated", "geman-mcclure"]

_STEP = 1.4  # of mu, as in the paper
_BINARY = 1e-6  # distance from 0 or 1 at which a weight counts as there
MAX_STAGES = 200
_ITERATIONS = 3  # of a stage before the last one


@dataclass(frozen=True)
class GraduatedNonConvexity:
    """A robust loss that is reached by graduated non-convexity; mu: of the surrogate that this is, None: the end."""

    scale: float = setting(3.0, "c: largest distance of an inlier's residual, standard deviations")
    loss: Loss = setting("truncated", "truncated: outliers are rejected altogether; geman-mcclure: nearly")
    mu: float | None = None

    def __post_init__(self) -> None:
        if not 0 < self.scale < np.inf:
            raise InputError(f"scale: expected a positive number, got {self.scale!r}")
        if self.loss not in get_args(Loss):
            raise InputError(f"loss: expected one of {', '.join(get_args(Loss))}, got {self.loss!r}")

    def first(self, distances: FloatArray) -> float:
        """mu to start from, given the distances of all residuals; infinite where no step is needed."""
        ratio = float(np.max(distances, initial=0.0) / self.scale) ** 2
        if self.loss == "truncated":
            return 1 / (2 * ratio - 1) if 2 * ratio > 1 else np.inf
        return max(1.0, 2 * ratio)

    def next(self, mu: float, weights: FloatArray) -> float | None:
        """The following mu, None after the last."""
        if self.loss == "truncated":
            binary = (np.minimum(weights, 1 - weights) < _BINARY).all()
            return None if binary else mu * _STEP
        return None if mu <= 1 else max(1.0, mu / _STEP)

    @property
    def last(self) -> float:
        """The mu at which the surrogate is the loss itself."""
        return np.inf if self.loss == "truncated" else 1.0

    def weights(self, mu: float, distances: FloatArray) -> FloatArray:
        """w of residuals at these distances (any shape)."""
        s = np.asarray(distances, dtype=np.float64) / self.scale
        if self.loss == "geman-mcclure":
            return np.asarray((mu / (s**2 + mu)) ** 2)
        if np.isinf(mu):
            return np.asarray((s <= 1).astype(np.float64))
        between = np.sqrt(mu * (mu + 1)) / np.maximum(s, 1e-300) - mu
        return np.asarray(np.where(s**2 <= mu / (mu + 1), 1.0, np.where(s**2 >= (mu + 1) / mu, 0.0, between)))

    def weight(self, distance: ArrayLike) -> FloatArray:
        """w of the surrogate at each distance, as `factors.Robust`."""
        return self.weights(self.last if self.mu is None else self.mu, np.asarray(distance, dtype=np.float64))

    def cost(self, distance: ArrayLike) -> FloatArray:
        """rho of the surrogate, rho'(s) = s w(s), at each distance."""
        q = np.square(np.asarray(distance, dtype=np.float64) / self.scale)
        mu, half = self.last if self.mu is None else self.mu, 0.5 * self.scale**2
        if self.loss == "geman-mcclure":
            return np.asarray(half * mu * q / (mu + q))
        if np.isinf(mu):
            return np.asarray(half * np.minimum(q, 1))
        between = 2 * np.sqrt(mu * (mu + 1) * q) - mu * (1 + q)
        return np.asarray(half * np.where(q <= mu / (mu + 1), q, np.where(q >= (mu + 1) / mu, 1.0, between)))

    def model(self, noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Robust:
        """GTSAM's noise model for the loss itself over `noise`."""
        kinds = gtsam.noiseModel.mEstimator
        made = kinds.TruncatedLeastSquares if self.loss == "truncated" else kinds.GemanMcClure
        return gtsam.noiseModel.Robust.Create(made.Create(self.scale), noise)


def solve_graduated(
    graph: gtsam.NonlinearFactorGraph, factors: Sequence[ActiveRows], start: gtsam.Values, settings: SolverSettings
) -> Solution:
    """The minimum as `factors.solve` finds it, those losses graduated that ask for it. Raises what `solve` raises."""
    losses = {k: loss for k, rows in enumerate(factors) if (loss := _loss(rows)) is not None}
    if not losses:
        return solve(graph, factors, start, settings)

    def solved(surrogates: Mapping[int, GraduatedNonConvexity | None], values: gtsam.Values, last: bool) -> Solution:
        staged = [_with(rows, surrogates[k]) if k in losses else rows for k, rows in enumerate(factors)]
        limit = settings.max_iterations if last else min(settings.max_iterations, _ITERATIONS)
        return solve(graph, staged, values, replace(settings, max_iterations=limit))

    def distances(values: gtsam.Values) -> dict[GraduatedNonConvexity, FloatArray]:
        parts = {loss: [_distances(factors[k], values) for k in losses if losses[k] == loss] for loss in kinds}
        return {loss: np.concatenate(parts[loss]) for loss in kinds}

    kinds = list(dict.fromkeys(losses.values()))
    solution = solved(dict.fromkeys(losses), start, last=True)
    found = distances(solution.values)
    mu: dict[GraduatedNonConvexity, float | None] = {loss: loss.first(found[loss]) for loss in kinds}
    for _ in range(MAX_STAGES):
        last = all(at is None for at in mu.values())
        solution = solved({k: replace(loss, mu=mu[loss]) for k, loss in losses.items()}, solution.values, last)
        if last:
            return solution
        found = distances(solution.values)
        for loss, at in mu.items():
            mu[loss] = None if at is None else loss.next(at, loss.weights(at, found[loss]))
    log.warning("graduated non-convexity has not settled in %d stages", MAX_STAGES)
    return solution


def _loss(rows: ActiveRows) -> GraduatedNonConvexity | None:
    loss = rows.group.factors.robust if isinstance(rows.group, ResidualGroup) else None
    return loss if isinstance(loss, GraduatedNonConvexity) else None


def _with(rows: ActiveRows, loss: GraduatedNonConvexity | None) -> ActiveRows:
    """Replace the loss of factors."""
    assert isinstance(rows.group, ResidualGroup)
    return replace(rows, group=ResidualGroup(replace(rows.group.factors, robust=loss)))


def _distances(rows: ActiveRows, values: gtsam.Values) -> FloatArray:
    """Distances (n,) of the residuals, standard deviations: without a loss the cost is s^2 / 2."""
    assert isinstance(rows.group, ResidualGroup)
    return np.sqrt(2 * replace(rows.group.factors, robust=None).errors(values, rows.chosen))

r"""Graduated non-convexity: robust estimation that does not depend on where it starts.

A robust loss that rejects outliers altogether has many local minima. It is reached from a convex surrogate with a
parameter mu; between two steps of mu the problem is solved with fixed weights, s being the distance of a residual in
standard deviations and c the largest that an inlier may have:

    geman-mcclure   w = ( mu c^2 / (s^2 + mu c^2) )^2          mu from 2 s_max^2 / c^2 down to 1, by 1.4
    truncated       w = 1                    s^2 <= mu/(mu+1) c^2
                        0                    s^2 >= (mu+1)/mu c^2       mu from c^2 / (2 s_max^2 - c^2) up, by 1.4,
                        c/s sqrt(mu(mu+1)) - mu  in between              until every weight is 0 or 1

Source: Yang, Antonante, Tzoumas, Carlone, Graduated Non-Convexity for Robust Spatial Perception, RA-L 2020.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from saga_fg.arrays import FloatArray
from saga_fg.errors import InputError
from saga_fg.settings import setting

Loss = Literal["truncated", "geman-mcclure"]

_STEP = 1.4  # of mu, as in the paper
_BINARY = 1e-6  # distance from 0 or 1 at which a weight counts as there


@dataclass(frozen=True)
class GraduatedNonConvexity:
    """A robust loss for `BatchSmoother`, reached by graduated non-convexity."""

    scale: float = setting(3.0, "c: largest distance of an inlier's residual, standard deviations")
    loss: Loss = setting("truncated", "truncated: outliers are rejected altogether; geman-mcclure: nearly")

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

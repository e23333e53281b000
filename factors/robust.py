"""Robust losses: weights of factors that fall with their residuals.

With s = || r ||_R the distance of the residual in standard deviations, a factor costs rho(s) instead of s^2 / 2.
Solvers reach its minimum by iteratively reweighted least squares: each linearisation is weighted by w(s) = rho'(s) / s.

| loss | rho(s) | w(s) |
|---|---|---|
| huber | s^2/2 up to c, then c (s - c/2) | 1 up to c, then c/s |
| cauchy | c^2/2 log(1 + s^2/c^2) | 1 / (1 + s^2/c^2) |
| geman-mcclure | c^2/2 s^2 / (c^2 + s^2) | c^4 / (c^2 + s^2)^2 |
| tukey | c^2/6 (1 - (1 - s^2/c^2)^3) up to c, then c^2/6 | (1 - s^2/c^2)^2 up to c, then 0 |

These are GTSAM's definitions (gtsam/linear/LossFunctions.h). Source: Z. Zhang, "Parameter estimation techniques",
Image and Vision Computing 15 (1997), table 1. With Gaussian residuals of one dimension, 95 % efficiency is reached at
c = 1.345 (huber), 2.385 (cauchy), 4.685 (tukey).

`Mixture` is the loss of a factor that holds with a probability P only; with 1 - P it says nothing:

    rho(s) = -log( P exp(-s^2 / 2) + 1 - P ),   w(s) = P exp(-s^2 / 2) / (P exp(-s^2 / 2) + 1 - P)

Source: E. Olson and P. Agarwal, "Inference on networks of mixtures for robust robot mapping", International Journal of
Robotics Research 32 (2013), here with the sum of the components.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol, get_args

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors.validation import FactorError, FloatArray, checked

Loss = Literal["huber", "cauchy", "geman-mcclure", "tukey"]


class RobustLoss(Protocol):
    """A robust loss as factors use it; `Robust` is one."""

    def cost(self, distance: ArrayLike) -> FloatArray: ...
    def weight(self, distance: ArrayLike) -> FloatArray: ...
    def model(self, noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Robust: ...


@dataclass(frozen=True)
class Robust:
    """A robust loss; `scale` is c, in standard deviations."""

    loss: Loss
    scale: float

    def __post_init__(self) -> None:
        if self.loss not in get_args(Loss):
            raise FactorError(f"loss: expected one of {', '.join(get_args(Loss))}, got {self.loss!r}")
        if not 0 < self.scale < np.inf:
            raise FactorError(f"scale: expected a positive number, got {self.scale!r}")

    def cost(self, distance: ArrayLike) -> FloatArray:
        """Return rho at each distance (any shape, standard deviations)."""
        return each_of(self._native().loss, distance)

    def weight(self, distance: ArrayLike) -> FloatArray:
        """Return w at each distance (any shape, standard deviations)."""
        return each_of(self._native().weight, distance)

    def model(self, noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Robust:
        """Return GTSAM's noise model for this loss over `noise`."""
        return gtsam.noiseModel.Robust.Create(self._native(), noise)

    def _native(self) -> Any:
        names = {"huber": "Huber", "cauchy": "Cauchy", "geman-mcclure": "GemanMcClure", "tukey": "Tukey"}
        return getattr(gtsam.noiseModel.mEstimator, names[self.loss]).Create(self.scale)


def each_of(function: Callable[[float], float], distance: ArrayLike) -> FloatArray:
    """A function of GTSAM's at each distance (any shape)."""
    s = np.asarray(distance, dtype=np.float64)
    return np.array([function(one) for one in s.ravel().tolist()]).reshape(s.shape)


@dataclass(frozen=True, eq=False)
class Mixture:
    """The loss of factors that hold with `probability` (n,), or one for all."""

    probability: FloatArray

    def __post_init__(self) -> None:
        given = np.asarray(self.probability, dtype=np.float64)
        every = checked("probability", np.atleast_1d(given), (None,))
        if (every < 0).any() or (every > 1).any():
            raise FactorError(f"probability: expected numbers from 0 to 1, got {given}")
        object.__setattr__(self, "probability", given)

    def cost(self, distance: ArrayLike) -> FloatArray:
        """Return rho at the distances (n,), standard deviations."""
        holds, fails = self._logarithms(distance)
        return np.asarray(-np.logaddexp(holds, fails))

    def weight(self, distance: ArrayLike) -> FloatArray:
        """Return w at the distances (n,)."""
        holds, fails = self._logarithms(distance)
        return np.asarray(np.exp(holds - np.logaddexp(holds, fails)))

    def of_row(self, row: int) -> Mixture:
        """Return the loss of one factor."""
        return Mixture(self.probability[row] if self.probability.ndim else self.probability)

    def model(self, noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Robust:
        """Return GTSAM's noise model for the loss of one factor over `noise`."""
        loss = gtsam.noiseModel.mEstimator.Custom.Create(
            lambda s: float(self.weight(float(s))), lambda s: float(self.cost(float(s)))
        )
        return gtsam.noiseModel.Robust.Create(loss, noise)

    def _logarithms(self, distance: ArrayLike) -> tuple[FloatArray, FloatArray]:
        with np.errstate(divide="ignore"):
            holds, fails = np.log(self.probability), np.log1p(-self.probability)
        return holds - np.square(distance) / 2, np.broadcast_to(fails, np.shape(holds))

"""Errors pooled over scenes, and consistency of their covariances (NEES).

The normalised estimation error squared (NEES) and the coverage of ellipses.

    nees = (x_hat - x)^T P^-1 (x_hat - x)        chi-squared with dim(x) degrees of freedom if P is right

so its mean is dim(x), and the share of samples with nees <= chi_square_quantile(p, dim) is p: the p-ellipse of the
estimate holds the truth with probability p.

Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4.2.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from saga_fg.numerics.arrays import FloatArray, checked
from saga_fg.numerics.gating import chi_square_quantile


@dataclass(frozen=True, eq=False)
class ErrorSample:
    """Errors `values` (N,) in one unit. Every statistic of an empty sample is NaN."""

    values: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", checked("values", self.values, (None,)))

    @classmethod
    def known(cls, values: FloatArray) -> Self:
        """The values that are finite."""
        return cls(values[np.isfinite(values)])

    @classmethod
    def pool(cls, samples: Iterable[ErrorSample]) -> Self:
        """All values of all samples together."""
        return cls(np.concatenate([np.empty(0), *(sample.values for sample in samples)]))

    def __len__(self) -> int:
        return len(self.values)

    @property
    def rmse(self) -> float:
        """Root of the mean square."""
        return float(np.sqrt(np.mean(self.values**2))) if len(self) else float("nan")

    @property
    def mean(self) -> float:
        return float(np.mean(self.values)) if len(self) else float("nan")

    @property
    def median(self) -> float:
        return float(np.median(self.values)) if len(self) else float("nan")

    @property
    def square_sums(self) -> tuple[float, float]:
        """(sum of squares, number of values), the sums for a bootstrap of the RMSE."""
        return float(np.sum(self.values**2)), float(len(self))


def nees(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """NEES (N,) of errors (N, d) under covariances (N, d, d); NaN for covariances unknown or not positive definite."""
    known = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    eigenvalues = np.linalg.eigvalsh(np.where(known[:, None, None], covariance, 0.0))
    proper = eigenvalues[:, 0] > 1e-12 * np.maximum(eigenvalues[:, -1], np.finfo(np.float64).tiny)
    result = np.full(len(error), np.nan)
    solved = np.linalg.solve(covariance[proper], error[proper][..., None])[..., 0]
    result[proper] = np.einsum("ni,ni->n", error[proper], solved)
    return result


def coverage(nees_values: FloatArray, probability: float, dimension: int = 2) -> float:
    """Share of errors inside the ellipse of a `probability`; NaN without values."""
    if len(nees_values) == 0:
        return float("nan")
    return float(np.mean(nees_values <= chi_square_quantile(probability, dimension)))


def coverages(nees_values: FloatArray, probabilities: Sequence[float] = (0.5, 0.9, 0.99)) -> dict[float, float]:
    """`coverage` of horizontal positions for several probabilities."""
    return {p: coverage(nees_values, p) for p in probabilities}

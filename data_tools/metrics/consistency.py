"""Consistency of covariances: the normalised estimation error squared (NEES) and the coverage of ellipses.

    nees = (x_hat - x)^T P^-1 (x_hat - x)        chi-squared with dim(x) degrees of freedom if P is right

so its mean is dim(x), and the share of samples with nees <= chi_square_quantile(p, dim) is p: the p-ellipse of the
estimate holds the truth with probability p.

Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4.2.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.chi_square import chi_square_quantile


def nees(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """NEES (N,) of errors (N, d) under covariances (N, d, d); NaN for covariances unknown or not positive definite."""
    known = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    eigenvalues = np.linalg.eigvalsh(np.where(known[:, None, None], covariance, 0.0))
    proper = eigenvalues[:, 0] > 1e-12 * np.maximum(eigenvalues[:, -1], np.finfo(np.float64).tiny)
    result = np.full(len(error), np.nan)
    solved = np.linalg.solve(covariance[proper], error[proper][..., None])[..., 0]
    result[proper] = np.einsum("ni,ni->n", error[proper], solved)
    return result


def negative_log_density(nees_values: FloatArray, covariance: FloatArray) -> FloatArray:
    """Negative logarithm (N,) of Gaussian densities of errors, nats; NaN where the NEES (N,) is.

    covariance (N, d, d)
    """
    known = np.isfinite(nees_values)
    result = np.full(len(nees_values), np.nan)
    result[known] = (nees_values[known] + np.linalg.slogdet(2 * np.pi * covariance[known])[1]) / 2
    return result


def coverage(nees_values: FloatArray, probability: float, dimension: int = 2) -> float:
    """Share of errors inside the ellipse of a `probability`; NaN without values."""
    if len(nees_values) == 0:
        return float("nan")
    return float(np.mean(nees_values <= chi_square_quantile(probability, dimension)))


def nees_band(count: int, dimension: int = 2, probability: float = 0.999) -> tuple[float, float]:
    """Two-sided interval that contains the mean NEES of `count` independent consistent estimates with `probability`."""
    tail = (1 - probability) / 2
    degrees = dimension * count
    return chi_square_quantile(tail, degrees) / count, chi_square_quantile(1 - tail, degrees) / count


def coverages(nees_values: FloatArray, probabilities: Sequence[float] = (0.5, 0.9, 0.99)) -> dict[float, float]:
    """`coverage` of horizontal positions for several probabilities."""
    return {p: coverage(nees_values, p) for p in probabilities}

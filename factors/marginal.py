"""Marginalising variables: they go, what they knew of the others stays.

    phi(x_b) = max_{x_a} prod phi(x_a, x_b)        ||A_a x_a + A_b x_b - b||^2  ->  ||(Q_2^T A_b) x_b - Q_2^T b||^2

with Q_2 the part of the QR factor of A_a that is orthogonal to it; for Gaussians this is the integral over x_a, up to a
constant. A node that disappears is marginalised, never just deleted together with its factors.
"""

from __future__ import annotations

from collections.abc import Iterable

import gtsam
import numpy as np

from factors.errors import FactorError
from factors.singular import singular_system
from factors.validation import FloatArray, checked_keys, format_keys


def marginal_factors(graph: gtsam.GaussianFactorGraph, eliminate: Iterable[int]) -> gtsam.GaussianFactorGraph:
    """Return factors on the remaining keys that carry all the graph says about them.

    Factors without eliminated keys are passed on as they are (shared, not copied). Raises `FactorError` for a key that
    the graph lacks, and `SingularSystemError` when the graph does not determine the eliminated variables.
    """
    gone = checked_keys("eliminate", eliminate)
    _present(graph, gone)
    if not gone:
        return graph
    try:
        conditionals, remaining = graph.eliminatePartialSequential(list(gone))  # in the order COLAMD finds best
    except RuntimeError as error:
        raise singular_system(graph, error) from error
    for i in range(conditionals.size()):  # GTSAM passes NaN on without a word
        if not np.isfinite(conditionals.at(i).augmentedJacobianUnweighted()).all():
            raise singular_system(graph)
    return remaining


def marginal_moments(graph: gtsam.GaussianFactorGraph, keys: Iterable[int]) -> tuple[FloatArray, FloatArray]:
    """Return the mean (D,) and covariance (D, D) of `keys` together, in this order, all other variables integrated out.

    Raises `FactorError` for a key that the graph lacks, `SingularSystemError` when the system is not determined.
    """
    wanted = checked_keys("keys", keys)
    _present(graph, wanted)
    others = set(graph.keyVector()) - set(wanted)
    remaining = marginal_factors(graph, others)
    if set(wanted) - set(remaining.keyVector()):  # nothing is left that speaks of them
        raise singular_system(graph)
    information, vector = remaining.hessian(gtsam.Ordering(list(wanted)))
    try:
        root = np.linalg.inv(np.linalg.cholesky(information))
    except np.linalg.LinAlgError as error:
        raise singular_system(graph, error) from error
    covariance = root.T @ root
    return covariance @ vector, covariance


def _present(graph: gtsam.GaussianFactorGraph, keys: tuple[int, ...]) -> None:
    known = set(graph.keyVector())
    missing = [key for key in keys if key not in known]
    if missing:
        raise FactorError(f"the graph has no variable {format_keys(missing)}")

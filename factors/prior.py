"""Priors of a variable, or of several together.

    phi(x) = || x - m ||_P^2

One variable's prior is the initial state of a track. A joint prior over many keys, P being their full joint
covariance, is what a filter knows of the past: all of it in one factor.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors.errors import FactorError
from factors.gaussian import GaussianFactors, gaussian_factor, native_factor, stacked_gaussian_factors
from factors.validation import checked, checked_key_array, checked_keys, whitener


def prior_factor(key: int, mean: ArrayLike, covariance: ArrayLike) -> gtsam.JacobianFactor:
    """Return the factor || x(key) - mean ||_covariance; mean: (d,), covariance: (d, d), positive definite."""
    center = checked("mean", mean, (None,))
    return gaussian_factor([key], [np.eye(len(center))], center, covariance)


def prior_factors(keys: ArrayLike, means: ArrayLike, covariances: ArrayLike) -> list[gtsam.JacobianFactor]:
    """Return one prior a key; keys: (n,); means: (n, d); covariances: (n, d, d), or one (d, d) for all."""
    return stacked_prior_factors(keys, means, covariances).native()


def stacked_prior_factors(keys: ArrayLike, means: ArrayLike, covariances: ArrayLike) -> GaussianFactors:
    """Return the factors of `prior_factors` as arrays."""
    centers = checked("means", means, (None, None))
    names = checked_key_array("keys", keys)
    checked_keys("keys", names.tolist())
    identity = np.broadcast_to(np.eye(centers.shape[1]), (*centers.shape, centers.shape[1]))
    return stacked_gaussian_factors(names[:, None], [identity], centers, covariances)


def joint_prior_factor(keys: Iterable[int], means: Sequence[ArrayLike], covariance: ArrayLike) -> gtsam.JacobianFactor:
    """Return one factor on all `keys` from their joint covariance.

    means: one vector (d_k,) a key; covariance: (D, D) with D = sum_k d_k, in the order of the keys, positive definite.
    Raises `FactorError` on anything else.
    """
    distinct = checked_keys("keys", keys)
    vectors = [checked("means", mean, (None,)) for mean in means]
    dims = [len(vector) for vector in vectors]
    if not distinct or len(vectors) != len(distinct) or 0 in dims:
        raise FactorError(f"means: expected one vector per key, got {len(vectors)} for {len(distinct)} keys")
    W = whitener("covariance", covariance, sum(dims))
    augmented = np.empty((len(W), len(W) + 1), order="F")
    augmented[:, :-1] = W
    augmented[:, -1] = W @ np.concatenate(vectors)
    return native_factor(distinct, dims, augmented)

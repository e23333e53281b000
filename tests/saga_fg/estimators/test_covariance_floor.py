"""Covariances that are not smaller than others."""

from __future__ import annotations

import numpy as np
import pytest

from saga_fg.estimators.block_gaussian import BlockGaussian, missing_covariance, not_smaller
from saga_fg.estimators.partition import Partition, StateLayout
from saga_fg.numerics.arrays import FloatArray


def covariance(rng: np.random.Generator, d: int) -> FloatArray:
    root = rng.normal(size=(d, d + 2))
    return np.asarray(root @ root.T)


def smallest_eigenvalue(P: FloatArray) -> float:
    return float(np.linalg.eigvalsh((P + P.T) / 2)[0])


def test_what_is_missing_makes_it_no_smaller_in_any_direction(subtests: pytest.Subtests) -> None:
    for seed in range(20):
        with subtests.test(seed=seed):
            rng = np.random.default_rng(seed)
            P, least = covariance(rng, 4), covariance(rng, 4)
            missing = missing_covariance(P, least)
            assert smallest_eigenvalue(missing) >= -1e-12
            assert smallest_eigenvalue(P + missing - least) >= -1e-10
            T = np.diag(10.0 ** rng.uniform(-3, 3, 4)) @ rng.normal(size=(4, 4))  # other units, other axes
            theirs = missing_covariance(T @ P @ T.T, T @ least @ T.T)
            expected = T @ missing @ T.T
            sigma = np.sqrt(np.diag(T @ least @ T.T))
            np.testing.assert_allclose(theirs / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=1e-6)


def test_nothing_is_missing_where_it_is_larger_already() -> None:
    least = covariance(np.random.default_rng(1), 3)
    np.testing.assert_allclose(missing_covariance(1.5 * least, least), 0.0, atol=1e-12)


def test_without_variance_in_a_direction_the_sum_is_taken() -> None:
    least = np.diag([1.0, 0.0])
    np.testing.assert_array_equal(missing_covariance(np.eye(2), least), least)


def test_only_the_nodes_that_are_named_change() -> None:
    rng = np.random.default_rng(2)
    layout = StateLayout(np.array([3, 5, 8, 9]), np.array([2, 2, 3, 2]))
    partition = Partition(layout, np.array([0, 1, 0, 1]))
    blocks = tuple(np.stack([covariance(rng, places.shape[1]) for _ in places]) for places in partition.groups)
    x = BlockGaussian(partition, rng.normal(size=layout.size), blocks)
    earlier = StateLayout(np.array([8, 3, 5]), np.array([3, 2, 2]))
    P = 4 * covariance(rng, 7)
    least = BlockGaussian(Partition(earlier, np.zeros(3, dtype=np.int64)), np.zeros(7), (P[None],))
    raised = not_smaller(x, least, np.array([3, 8, 9]))  # 9 has come since
    np.testing.assert_array_equal(raised.mean, x.mean)
    np.testing.assert_array_equal(raised.joint(np.array([1, 3])), x.joint(np.array([1, 3])))
    both = np.array([0, 2])
    assert smallest_eigenvalue(raised.joint(both) - least.joint(np.array([1, 0]))) >= -1e-10
    assert smallest_eigenvalue(raised.joint(both) - x.joint(both)) >= -1e-10
    assert smallest_eigenvalue(raised.joint(np.arange(4))) > 0

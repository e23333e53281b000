"""Bootstrap over scenes and consistency figures."""

import numpy as np
import pytest

from data_tools.metrics import (
    ErrorSample,
    coverage,
    difference,
    nees,
    paired_bootstrap,
    ratio_of_sums,
)
from saga_fg import InputError


def test_a_constant_factor_is_found_exactly():
    rng = np.random.default_rng(1)
    b = [ErrorSample(rng.rayleigh(1.0, size=50)) for _ in range(8)]
    a = [ErrorSample(0.7 * sample.values) for sample in b]
    interval = paired_bootstrap([s.square_sums for s in a], [s.square_sums for s in b])
    assert interval.estimate == pytest.approx(-0.3)
    assert (interval.low, interval.high) == pytest.approx((-0.3, -0.3))


def test_totals_are_pooled_not_averaged_over_scenes():
    interval = paired_bootstrap([[90.0, 100.0], [0.0, 1.0]], [[50.0, 100.0], [1.0, 1.0]], ratio_of_sums, difference)
    assert interval.estimate == pytest.approx(90 / 101 - 51 / 101)


def test_the_interval_covers_as_often_as_it_says():
    rng = np.random.default_rng(2)
    hits = 0
    for k in range(200):
        common = rng.normal(size=30)
        a, b = common + 0.5 + rng.normal(0, 0.3, 30), common
        sums = [np.stack([x, np.ones(30)], axis=1) for x in (a, b)]
        interval = paired_bootstrap(*sums, ratio_of_sums, difference, confidence=0.9, draws=500, seed=k)
        hits += interval.low <= 0.5 <= interval.high
    assert 0.82 <= hits / 200 <= 0.96


def test_seed_decides():
    sums = np.random.default_rng(3).uniform(1, 2, size=(2, 9, 2))
    first = paired_bootstrap(*sums)
    assert first == paired_bootstrap(*sums)
    assert first != paired_bootstrap(*sums, seed=1)
    assert "[" in str(first)


def test_draws_without_data_are_left_out():
    interval = paired_bootstrap([[0.0, 0.0], [4.0, 4.0]], [[0.0, 0.0], [1.0, 4.0]])
    assert interval.estimate == interval.low == interval.high == pytest.approx(1.0)
    nothing = paired_bootstrap([[0.0, 0.0]], [[0.0, 0.0]])
    assert np.isnan(nothing.low)


def test_bad_input(subtests):
    for a, b, confidence, text in [
        ([[1.0, 2.0]], [[1.0, 2.0], [1.0, 2.0]], 0.95, "b: expected shape"),
        (np.empty((0, 2)), np.empty((0, 2)), 0.95, "at least one scene"),
        ([[1.0, 2.0]], [[1.0, 2.0]], 1.0, "confidence"),
    ]:
        with subtests.test(a=a, b=b, confidence=confidence, text=text), pytest.raises(InputError, match=text):
            paired_bootstrap(a, b, confidence=confidence)


def test_nees_of_consistent_estimates_lies_in_its_band():
    rng = np.random.default_rng(4)
    L = rng.normal(size=(500, 2, 2))
    covariance = L @ np.swapaxes(L, 1, 2) + 0.1 * np.eye(2)
    error = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), rng.normal(size=(500, 2)))
    values = nees(error, covariance)
    assert abs(values.mean() - 2) < 4 * np.sqrt(4 / 500)  # chi-squared with 2 degrees of freedom
    assert nees(2 * error, covariance) == pytest.approx(4 * values)
    for p in (0.5, 0.9, 0.99):
        assert abs(coverage(values, p) - p) < 4 * np.sqrt(p * (1 - p) / 500)


def test_nees_of_a_degenerate_covariance_is_unknown():
    values = nees(np.ones((3, 2)), np.stack([np.zeros((2, 2)), np.diag([1.0, 0.0]), np.eye(2)]))
    assert np.isnan(values[:2]).all()
    assert values[2] == pytest.approx(2.0)


def test_error_samples_pool():
    pooled = ErrorSample.pool([ErrorSample(np.array([3.0])), ErrorSample(np.empty(0)), ErrorSample(np.array([4.0]))])
    assert len(pooled) == 2
    assert pooled.rmse == pytest.approx(np.sqrt(12.5))
    assert pooled.square_sums == (25.0, 2.0)
    with pytest.raises(InputError):
        ErrorSample(np.array([np.nan]))

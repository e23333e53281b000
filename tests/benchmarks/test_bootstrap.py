"""Intervals by the bootstrap over scenes."""

import numpy as np
import pytest

from benchmarks.runner import difference, paired_bootstrap, ratio_of_sums, square_sums
from data_tools.metrics import ErrorSample
from saga_fg.errors import InputError


def test_totals_are_pooled_and_a_constant_factor_is_found_exactly():
    rng = np.random.default_rng(1)
    b = [ErrorSample(rng.rayleigh(1.0, size=50)) for _ in range(8)]
    a = [ErrorSample(0.7 * sample.values) for sample in b]
    interval = paired_bootstrap([*map(square_sums, a)], [*map(square_sums, b)])
    assert interval.estimate == pytest.approx(-0.3)
    assert (interval.low, interval.high) == pytest.approx((-0.3, -0.3))
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


def test_the_seed_decides_and_draws_without_data_are_left_out():
    sums = np.random.default_rng(3).uniform(1, 2, size=(2, 9, 2))
    first = paired_bootstrap(*sums)
    assert first == paired_bootstrap(*sums)
    assert first != paired_bootstrap(*sums, seed=1)
    assert "[" in str(first)
    interval = paired_bootstrap([[0.0, 0.0], [4.0, 4.0]], [[0.0, 0.0], [1.0, 4.0]])
    assert interval.estimate == interval.low == interval.high == pytest.approx(1.0)
    nothing = paired_bootstrap([[0.0, 0.0]], [[0.0, 0.0]])
    assert np.isnan(nothing.low)


def test_bad_sums(subtests):
    for a, b, confidence, text in [
        ([[1.0, 2.0]], [[1.0, 2.0], [1.0, 2.0]], 0.95, "b: expected shape"),
        (np.empty((0, 2)), np.empty((0, 2)), 0.95, "at least one scene"),
        ([[1.0, 2.0]], [[1.0, 2.0]], 1.0, "confidence"),
    ]:
        with subtests.test(a=a, b=b, confidence=confidence, text=text), pytest.raises(InputError, match=text):
            paired_bootstrap(a, b, confidence=confidence)

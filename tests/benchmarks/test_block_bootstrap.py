"""Intervals of ratios of averages over blocks."""

import numpy as np
import pytest

from benchmarks.block_bootstrap import relative_change_of_errors
from saga_fg.errors import InputError


@pytest.mark.parametrize("average", ["median", "mean"])
def test_a_known_change_is_inside_its_interval(average):
    rng = np.random.default_rng(0)
    b = rng.gamma(2.0, 1.0, 900)
    a = 0.7 * b * rng.uniform(0.8, 1.2, 900)
    found = relative_change_of_errors(a, b, np.arange(900) // 10, average)
    assert found.low < found.estimate < found.high
    assert found.low < -0.3 < found.high
    assert found.excludes(0.0)


def test_equal_errors_do_not_change():
    errors = np.array([1.0, 2.0, 5.0, 0.5])
    found = relative_change_of_errors(errors, errors, [0, 0, 1, 2], "median")
    assert (found.estimate, found.low, found.high) == (0.0, 0.0, 0.0)


def test_where_neither_errs_nothing_changes():
    """A stationary object is annotated at one place, and predicted there."""
    a, b = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 2.0])
    found = relative_change_of_errors(a, b, [0, 0, 1], "median")
    assert (found.estimate, found.low, found.high) == (0.0, -0.5, 0.0)


def test_errors_that_come_in_blocks_are_worth_less():
    rng = np.random.default_rng(1)
    b = np.ones(400)
    a = np.repeat(rng.uniform(0.5, 1.5, 20), 20)
    together = relative_change_of_errors(a, b, np.arange(400) // 20, "mean")
    apart = relative_change_of_errors(a, b, np.arange(400), "mean")
    assert together.high - together.low > 2 * (apart.high - apart.low)


def test_no_errors_and_unequal_lengths_are_refused():
    with pytest.raises(InputError, match="at least one error"):
        relative_change_of_errors([], [], [], "mean")
    with pytest.raises(InputError, match="b"):
        relative_change_of_errors([1.0], [1.0, 2.0], [0], "mean")

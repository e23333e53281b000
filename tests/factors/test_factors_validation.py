"""Checks at the door: what is accepted comes out right, what is not is named."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factors import FactorError
from factors.validation import (
    checked,
    checked_key_array,
    checked_key_rows,
    checked_keys,
    format_key,
    whitener,
    whiteners,
)


@given(st.integers(0, 2**32 - 1), st.integers(1, 7))
def test_whitened_covariance_is_identity(seed, dim):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(dim, dim)) * np.exp(rng.uniform(-3, 3, dim))[:, None]
    covariance = root @ root.T + 1e-3 * np.diag(np.diag(root @ root.T))
    W = whitener("Q", covariance, dim)
    np.testing.assert_allclose(W @ covariance @ W.T, np.eye(dim), atol=1e-7)
    assert (np.tril(W, -1) == 0).all()


def test_bad_covariance_is_refused(subtests):
    for covariance, message in [
        ([[1.0, 1.0], [1.0, 1.0]], "singular"),
        ([[1e-30, 0.0], [0.0, 0.0]], "singular"),
        ([[1.0, 2.0], [2.0, 1.0]], "singular or indefinite"),
        ([[-1.0, 0.0], [0.0, 1.0]], "singular or indefinite"),
        ([[1.0, 0.5], [0.0, 1.0]], "symmetric"),
        ([[1.0, np.nan], [np.nan, 1.0]], r"Q\[0, 1\]: expected a finite number, got nan"),
        ([[1.0, 0.0]], r"expected shape \(2, 2\), got \(1, 2\)"),
        ([1.0, 1.0], "expected shape"),
        ("noise", "expected numbers"),
    ]:
        with subtests.test(message), pytest.raises(FactorError, match=message):
            whitener("Q", covariance, 2)


def test_scale_does_not_make_a_covariance_singular():
    covariance = np.diag([1e-12, 1e12])
    np.testing.assert_allclose(whitener("Q", covariance, 2), np.diag([1e6, 1e-6]))


def test_bad_entry_of_a_stack_is_named():
    stack = np.stack([np.eye(2), np.ones((2, 2)), np.eye(2)])
    with pytest.raises(FactorError, match=r"Q\[1\]"):
        whiteners("Q", stack)


def test_bad_keys_are_refused(subtests):
    for keys in [[-1], [1.5], ["x"], [2**64], [[1, 2]], [True], [None]]:
        with subtests.test(keys=keys):
            with pytest.raises(FactorError, match=r"integers|shape"):
                checked_key_rows("keys", [keys], 1)
            with pytest.raises(FactorError, match=r"integers|shape"):
                checked_keys("keys", keys)


def test_keys_cover_the_whole_range_of_gtsam():
    keys = [0, gtsam.symbol("x", 3), 2**64 - 1]
    assert checked_keys("keys", keys) == tuple(keys)
    assert checked_key_array("keys", np.array(keys, np.uint64)).tolist() == keys
    assert [format_key(key) for key in keys] == ["0", "x3", str(2**64 - 1)]


def test_repeated_key_is_named():
    with pytest.raises(FactorError, match="x1 occurs twice"):
        checked_keys("keys", [gtsam.symbol("x", 1), 2, gtsam.symbol("x", 1)])


def test_first_entry_that_is_not_finite_is_named():
    with pytest.raises(FactorError, match=r"b\[1, 0\]: expected a finite number, got inf"):
        checked("b", [[1.0, 2.0], [np.inf, np.nan]], (2, 2))

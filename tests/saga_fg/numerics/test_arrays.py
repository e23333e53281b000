"""Arrays are converted, checked and frozen at the door; what is wrong is named."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from saga_fg import InputError, SagaError
from saga_fg.numerics.arrays import checked, checked_covariances, checked_ids, checked_labels


@given(arrays(np.float64, array_shapes(max_dims=3), elements=st.floats(allow_nan=False, allow_infinity=False)))
def test_finite_arrays_pass_unchanged_as_read_only_copies(values):
    result = checked("values", values, values.shape)
    assert np.array_equal(result, values)
    assert result.dtype == np.float64
    assert not result.flags.writeable
    assert not np.shares_memory(result, values)


def test_lists_and_integers_become_floats():
    assert checked("values", [[1, 2], [3, 4]], (None, 2)).tolist() == [[1.0, 2.0], [3.0, 4.0]]


def test_an_empty_list_is_no_rows_of_anything(subtests):
    for shape in [(None, 3), (None, 2, 2), (None,)]:
        with subtests.test(shape=shape):
            assert checked("values", [], shape).shape == tuple(n or 0 for n in shape)


def test_wrong_arrays_are_named(subtests):
    for value, shape, message in [
        ([1.0, 2.0], (3,), r"speed: expected shape \(3,\), got \(2,\)"),
        ([[1.0, 2.0]], (None, 3), r"speed: expected shape \(any, 3\), got \(1, 2\)"),
        (1.0, (None,), r"speed: expected shape \(any,\), got \(\)"),
        (["fast"], (1,), r"speed: expected numbers, got \['fast'\]"),
        ([[1.0], [1.0, 2.0]], (2, None), "speed: expected numbers, got"),
        ([10**400], (1,), "speed: expected numbers, got"),
        ([1j], (1,), "speed: expected numbers, got"),
        ([0.0, np.nan], (2,), r"speed\[1\]: expected a finite number, got nan"),
        ([[0.0, 0.0], [np.inf, 0.0]], (2, 2), r"speed\[1, 0\]: expected a finite number, got inf"),
        ([None], (1,), r"speed\[0\]: expected a finite number, got nan"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            checked("speed", value, shape)


def test_complex_arrays_are_not_silently_made_real():
    with pytest.raises(InputError, match="speed: expected numbers"):
        checked("speed", np.array([1 + 2j]), (1,))


def test_nan_is_let_in_only_where_it_means_unknown():
    assert np.isnan(checked("velocity", [np.nan], (1,), "finite-or-nan")).all()
    with pytest.raises(InputError, match=r"velocity\[0\]: expected a finite number, or NaN for unknown, got -inf"):
        checked("velocity", [-np.inf], (1,), "finite-or-nan")
    assert np.isinf(checked("velocity", [-np.inf], (1,), "any")).all()


def test_a_long_value_is_cut_in_the_message():
    with pytest.raises(InputError) as caught:
        checked("speed", ["fast"] * 100, (None,))
    assert len(str(caught.value)) < 120


def test_input_errors_are_value_errors_and_saga_errors():
    assert issubclass(InputError, ValueError)
    assert issubclass(InputError, SagaError)


@given(st.lists(st.text(min_size=1, alphabet=st.characters(exclude_characters="\0", exclude_categories=["Cs"]))))
def test_labels_are_kept(labels):
    result = checked_labels("label", labels, len(labels))
    assert result.tolist() == labels
    assert not result.flags.writeable


def test_wrong_labels_are_named(subtests):
    for value, length, message in [
        (["car", ""], None, r"label\[1\]: expected a name, got an empty string"),
        (["car"], 2, "label: expected 2 entries, got 1"),
        ([], 1, "label: expected 1 entries, got 0"),
        ([1, 2], None, r"label: expected a list of strings, got \[1, 2\]"),
        ("car", None, "label: expected a list of strings, got 'car'"),
        (None, None, "label: expected a list of strings, got None"),
        (["car", None], None, "label: expected a list of strings"),
        ([["car"]], None, "label: expected a list of strings"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            checked_labels("label", value, length)


@given(st.lists(st.integers(-(2**63), 2**63 - 1), unique=True))
def test_ids_are_kept(ids):
    result = checked_ids("nodes", ids, len(ids))
    assert result.tolist() == ids
    assert not result.flags.writeable


def test_wrong_ids_are_named(subtests):
    for value, length, message in [
        ([3, 1, 3], None, "nodes: expected unique ids, 3 occurs more than once"),
        ([1.0], None, r"nodes: expected a list of integers, got \[1.0\]"),
        ([True], None, "nodes: expected a list of integers"),
        (["1"], None, "nodes: expected a list of integers"),
        (1, None, "nodes: expected a list of integers, got 1"),
        ([[1]], None, "nodes: expected a list of integers"),
        ([1], 2, "nodes: expected 2 entries, got 1"),
        ([2**63], None, "nodes: expected a list of integers"),
        ([10**400], None, "nodes: expected a list of integers"),
        ([[1], [1, 2]], None, "nodes: expected a list of integers"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            checked_ids("nodes", value, length)


@given(st.integers(0, 2**32 - 1), st.integers(0, 4), st.integers(1, 5))
def test_covariances_are_accepted_and_made_exactly_symmetric(seed, count, dim):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(count, dim, dim)) * 10.0 ** rng.uniform(-6, 6, (count, dim, 1))
    P = A @ np.swapaxes(A, 1, 2) + np.einsum("kii->ki", A @ np.swapaxes(A, 1, 2))[:, :, None] * 1e-3 * np.eye(dim)
    off = P * (1 + 1e-13 * rng.normal(size=P.shape))
    result = checked_covariances("R", off, count, dim)
    assert np.array_equal(result, np.swapaxes(result, 1, 2))
    assert np.allclose(result, P, rtol=1e-11, atol=0)
    assert not result.flags.writeable


def test_rounding_next_to_zero_is_no_asymmetry():
    turned = np.array([[1.0, 1e-17], [-1e-17, 1.0]])
    assert checked_covariances("R", [turned], 1, 2)[0].tolist() == np.eye(2).tolist()


def test_units_do_not_make_a_matrix_singular():
    assert checked_covariances("R", [np.diag([1e-12, 1e12])], 1, 2).shape == (1, 2, 2)


def test_what_is_no_covariance_is_named(subtests):
    for bad, message in [
        (np.diag([1.0, 0.0]), r"R\[1\]: expected a positive definite matrix, got \[\[1.0, 0.0\], \[0.0, 0.0\]\]"),
        (np.zeros((2, 2)), r"R\[1\]: expected a positive definite matrix"),
        (np.diag([1.0, -1.0]), r"R\[1\]: expected a positive definite matrix"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), r"R\[1\]: expected a positive definite matrix"),
        (np.outer([0.1, 0.7], [0.1, 0.7]), r"R\[1\]: expected a positive definite matrix"),
        (np.array([[1.0, 0.5], [0.4, 1.0]]), r"R\[1\]: expected a symmetric matrix"),
        (np.array([[1.0, np.nan], [np.nan, 1.0]]), r"R\[1, 0, 1\]: expected a finite number"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            checked_covariances("R", [np.eye(2), bad], 2, 2)

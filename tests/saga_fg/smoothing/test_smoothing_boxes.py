"""Sizes, headings, heights and scores of smoothed objects."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg.smoothing import StateTable, constant_sizes, quality_of, scalar_readings, smooth_walks
from saga_fg.smoothing.boxes import weighted_medians


def chain(moments: int, objects: int = 1) -> StateTable:
    """States of objects that live at all moments."""
    ids = np.arange(objects)
    return StateTable.of_moments(
        [(k, ids, np.zeros((objects, 4)), np.tile(np.eye(4), (objects, 1, 1))) for k in range(moments)]
    )


@given(st.lists(st.floats(-100, 100), min_size=1, max_size=9))
def test_with_equal_weights_the_weighted_median_is_the_median(values: list[float]) -> None:
    array = np.array(values)
    median = weighted_medians(np.zeros(len(array), dtype=np.int64), 1, array, np.ones(len(array)))
    assert median[0] == pytest.approx(np.median(array))


def test_sizes_follow_the_weight_and_are_unknown_without_detection() -> None:
    size = np.array([[4.0, 2.0, 1.5], [4.2, 2.0, 1.5], [9.0, 3.0, 2.0], [np.nan] * 3])
    owner, probability = np.array([0, 0, 0, 2]), np.array([0.9, 0.9, 0.1, 0.9])
    found = constant_sizes(owner, 3, size, probability, np.full(4, 10.0))
    assert 4.0 <= found[0, 0] <= 4.2
    assert np.isnan(found[1:]).all()


def test_a_walk_without_drift_is_the_weighted_mean() -> None:
    states = chain(5)
    rows, value, variance = np.arange(5), np.array([1.0, 2.0, 0.0, 4.0, 1.5]), np.array([1.0, 2.0, 0.5, 1.0, 4.0])
    mean, var = smooth_walks(states, np.zeros(5), scalar_readings(rows, value, variance))
    assert np.allclose(mean, np.average(value, weights=1 / variance))
    assert np.allclose(var, 1 / np.sum(1 / variance))


def test_a_walk_is_smoothed_as_by_the_textbook() -> None:
    rng = np.random.default_rng(3)
    n, growth = 7, 0.3
    value, variance = rng.normal(0, 1, n), rng.uniform(0.5, 2, n)
    states = chain(n)
    mean, var = smooth_walks(states, np.full(n, growth), scalar_readings(np.arange(n), value, variance))
    D = np.diff(np.eye(n), axis=0)
    information = np.diag(1 / variance) + D.T @ D / growth
    assert np.allclose(mean, np.linalg.solve(information, value / variance))
    assert np.allclose(var, np.diag(np.linalg.inv(information)))


def test_moments_before_the_first_reading_are_told_by_it() -> None:
    mean, var = smooth_walks(
        chain(4), np.full(4, 0.5), scalar_readings(np.array([2]), np.array([7.0]), np.array([1.0]))
    )
    assert mean.tolist() == [7.0] * 4
    assert var.tolist() == [2.0, 1.5, 1.0, 1.5]


def test_readings_modulo_half_a_turn_ignore_flips() -> None:
    truth = np.linspace(3.0, 3.4, 9)
    flipped = truth + np.pi * np.array([0, 1, 0, 0, -1, 1, 0, 1, 0])
    mean, _ = smooth_walks(chain(9), np.full(9, 0.05), scalar_readings(np.arange(9), flipped, np.full(9, 0.01)), np.pi)
    assert np.allclose(mean, truth, atol=0.05)


def test_objects_do_not_mix_and_rows_may_repeat() -> None:
    states = chain(2, objects=2)
    assert states.previous.tolist() == [-1, -1, 0, 1]
    readings = scalar_readings(np.array([0, 0, 3]), np.array([1.0, 3.0, 9.0]), np.ones(3))
    mean, _ = smooth_walks(states, np.zeros(4), readings)
    assert mean.tolist() == [2.0, 9.0, 2.0, 9.0]


def test_quality_needs_score_and_precision() -> None:
    P = np.array([0.01, 0.01, 0.25, 4.0])[:, None, None] * np.eye(2)
    assert quality_of(np.array([0.9, 0.3, 0.9, 0.9]), P).tolist() == ["high", "medium", "medium", "low"]

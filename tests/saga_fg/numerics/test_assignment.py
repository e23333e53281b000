"""Association: the gate lets through what it promises, the assignment is the best there is."""

import itertools
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from saga_fg.numerics.assignment import assign, gate, mahalanobis

seeds = st.integers(0, 2**32 - 1)


def covariances(rng, n):
    A = rng.normal(size=(n, 2, 2))
    return A @ np.swapaxes(A, 1, 2) + 0.1 * np.eye(2)


@given(seeds, st.integers(0, 4), st.integers(0, 4))
def test_distances_are_the_textbooks(seed, n, m):
    rng = np.random.default_rng(seed)
    position, measured, P, R = (
        rng.normal(size=(n, 2)),
        rng.normal(size=(m, 2)),
        covariances(rng, n),
        covariances(rng, m),
    )
    d2, log_det = mahalanobis(position, P, measured, R)
    assert d2.shape == log_det.shape == (n, m)
    for i, j in itertools.product(range(n), range(m)):
        innovation, S = measured[j] - position[i], P[i] + R[j]
        assert d2[i, j] == pytest.approx(innovation @ np.linalg.solve(S, innovation))
        assert log_det[i, j] == pytest.approx(np.linalg.slogdet(S)[1])


def test_the_gate_lets_its_share_through(subtests):
    for probability, dim in product([0.5, 0.9, 0.99], [2, 4]):
        with subtests.test(probability=probability, dim=dim):
            samples = (np.random.default_rng(0).normal(size=(200_000, dim)) ** 2).sum(axis=1)
            assert (samples < gate(probability, dim)).mean() == pytest.approx(probability, abs=0.004)


def total(cost, unmatched, rows, columns):
    """Gain against matching nothing."""
    return sum(
        float(cost[i, j] - np.broadcast_to(unmatched, cost.shape)[i, j]) for i, j in zip(rows, columns, strict=True)
    )


def best_by_brute_force(cost, possible, unmatched):
    n, m = cost.shape
    best = 0.0
    for k in range(1, min(n, m) + 1):
        for rows in itertools.combinations(range(n), k):
            for columns in itertools.permutations(range(m), k):
                if all(possible[i, j] for i, j in zip(rows, columns, strict=True)):
                    best = min(best, total(cost, unmatched, rows, columns))
    return best


@given(st.integers(1, 4), st.integers(1, 4), st.data())
def test_the_assignment_is_the_best_of_all(n, m, data):
    cost = data.draw(arrays(np.float64, (n, m), elements=st.floats(-20, 20)))
    possible = data.draw(arrays(np.bool_, (n, m)))
    unmatched = data.draw(st.one_of(st.floats(-5, 25), arrays(np.float64, (n, 1), elements=st.floats(-5, 25))))
    rows, columns = assign(cost, possible, unmatched)
    assert len(set(rows.tolist())) == len(rows)
    assert len(set(columns.tolist())) == len(columns)
    assert possible[rows, columns].all()
    assert total(cost, unmatched, rows, columns) == pytest.approx(
        best_by_brute_force(cost, possible, unmatched), abs=1e-9
    )


def test_a_pair_that_costs_more_than_none_is_left_out():
    cost = np.array([[3.0, 9.0], [1.0, 2.0]])
    everything = np.ones((2, 2), dtype=bool)
    rows, columns = assign(cost, everything, 5.0)
    assert list(zip(rows.tolist(), columns.tolist(), strict=True)) == [(0, 0), (1, 1)]
    rows, columns = assign(cost, everything, 2.5)
    assert list(zip(rows.tolist(), columns.tolist(), strict=True)) == [(1, 0)]
    rows, columns = assign(cost, everything, np.array([[10.0], [0.5]]))
    assert list(zip(rows.tolist(), columns.tolist(), strict=True)) == [(0, 0)]


def test_greed_does_not_pay():
    """The cheapest pair first would leave the other track alone."""
    rows, columns = assign(np.array([[1.0, 2.0], [1.5, 9.0]]), np.ones((2, 2), dtype=bool), 5.0)
    assert list(zip(rows.tolist(), columns.tolist(), strict=True)) == [(0, 1), (1, 0)]


def test_nothing_possible(subtests):
    for shape in [(0, 0), (0, 3), (3, 0), (2, 3)]:
        with subtests.test(shape=shape):
            rows, columns = assign(np.zeros(shape), np.zeros(shape, dtype=bool), 5.0)
            assert (len(rows), len(columns)) == (0, 0)

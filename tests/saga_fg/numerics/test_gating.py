"""Pairs within reach: the tree finds what comparing all distances finds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg.numerics import gating as module
from saga_fg.numerics.gating import near_pairs


def by_distances(a, b, reach, further):
    distance = np.hypot(*np.moveaxis(a[:, None] - b, -1, 0))
    return np.nonzero(distance <= reach[:, None] + further)


@pytest.fixture(params=[0, 10**9], ids=["tree", "kernel"])
def most_compared(request, monkeypatch):
    monkeypatch.setattr(module, "MAX_COMPARED", request.param)


@pytest.mark.usefixtures("most_compared")
def test_pairs_are_those_of_all_distances_in_order(subtests):
    for seed in range(5):
        with subtests.test(seed=seed):
            rng = np.random.default_rng(seed)
            a, b = rng.uniform(-50, 50, (80, 2)), rng.uniform(-50, 50, (60, 2))
            reach, further = rng.lognormal(1, 1.5, 80), rng.uniform(0, 2, 60)
            found = near_pairs(a, b, reach, further)
            np.testing.assert_array_equal(found, by_distances(a, b, reach, further))
            assert len(found[0]) > 20


@pytest.mark.usefixtures("most_compared")
def test_unknown_reaches_find_nothing_and_infinite_ones_everything():
    a, b = np.array([[0.0, 0.0], [1e9, 0.0], [0.0, 0.0]]), np.array([[0.0, 1.0], [5.0, 5.0]])
    i, j = near_pairs(a, b, np.array([np.nan, np.inf, 1.0]), np.array([0.0, np.nan]))
    assert (i.tolist(), j.tolist()) == ([1, 2], [0, 0])


@pytest.mark.usefixtures("most_compared")
def test_nothing_is_near_nothing(subtests):
    for n, m in [(0, 0), (0, 3), (3, 0)]:
        with subtests.test(n=n, m=m):
            i, j = near_pairs(np.zeros((n, 2)), np.zeros((m, 2)), np.ones(n))
            assert len(i) == len(j) == 0


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 1e-3, 1.0, 1e5]))
def test_a_place_is_near_itself(seed, reach):
    places = np.random.default_rng(seed).normal(scale=1e4, size=(310, 2))
    i, j = near_pairs(places, places, np.full(len(places), reach))
    assert set(zip(range(310), range(310), strict=True)) <= set(zip(i.tolist(), j.tolist(), strict=True))


def test_reaches_may_be_whole_numbers() -> None:
    a = np.array([[0.0, 0.0], [10.0, 0.0]])
    rows, columns = near_pairs(a, a[:1] + 1.0, np.full(2, 2), 0)
    assert rows.tolist() == [0]
    assert columns.tolist() == [0]

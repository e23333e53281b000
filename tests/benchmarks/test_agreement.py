"""Pairwise agreement of two groupings."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.agreement import pairwise_agreement

GROUPS = st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), max_size=20)


def test_an_example_by_hand() -> None:
    found = pairwise_agreement([1, 1, 1, 2, 2], [7, 7, 8, 8, 8])
    assert found.precision == pytest.approx(2 / 4)
    assert found.recall == pytest.approx(2 / 4)
    assert pairwise_agreement([1, 2, 3], [1, 1, 1]).recall == 0
    assert pairwise_agreement([], []).f1 == 1


@given(GROUPS)
def test_it_counts_pairs(groups: list[tuple[int, int]]) -> None:
    a, b = (np.array([group[side] for group in groups], dtype=np.int64) for side in (0, 1))
    upper = np.triu_indices(len(a), 1)
    one, other = (a[:, None] == a)[upper], (b[:, None] == b)[upper]
    found = pairwise_agreement(a, b)
    assert found.precision == pytest.approx((one & other).sum() / one.sum() if one.any() else 1)
    assert found.recall == pytest.approx((one & other).sum() / other.sum() if other.any() else 1)
    assert pairwise_agreement(a, a + 100).f1 == 1

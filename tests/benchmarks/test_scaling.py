"""Node-only filtering beside filters with edge states: the full one agrees exactly."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.filters import JointGraphTracking, SeparateGraphTracking
from benchmarks.flocks import flock
from benchmarks.scaling import APART, JOINT, NODES, SEPARATE


def test_with_all_correlations_edges_say_nothing_that_nodes_do_not(bench) -> None:
    """The node-only filter keeps the accuracy: the paper's claim, to the last digits. Two objects, of which one is
    hidden and the other missed now and then, leave frames that are predictions alone."""
    found = bench("scaling --objects 2,4,6 --joint-limit 4 --frames 60")
    rows = {(row["objects"], row["filter"]): row for row in found}
    for n in (2, 4):
        assert rows[n, JOINT]["off by, sigma"] < 1e-9
        assert rows[n, JOINT]["RMSE hidden, m"] == pytest.approx(rows[n, NODES]["RMSE hidden, m"], abs=1e-12)
        assert rows[n, JOINT]["numbers"] == n * rows[n, NODES]["numbers"]
    assert {name for n, name in rows if n == 6} == {NODES, SEPARATE, APART}, "beyond the limit"
    for (n, _), row in rows.items():
        assert row["/ nodes"] == pytest.approx(row["ms a frame"] / rows[n, NODES]["ms a frame"])


def test_edges_of_their_own_are_right_where_nothing_couples_the_nodes() -> None:
    """Without interactions the nodes are independent, and both filters are the classical one."""
    drawn = flock("connected", 3, 15, 0, mixing=0.0)
    together, apart = JointGraphTracking(drawn), SeparateGraphTracking(drawn)
    for frame in drawn.frames:
        for each in (together, apart):
            each.prepare(frame)()
    for a, b in zip(together.read(), apart.read(), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)


def test_one_object_has_no_neighbours(refused) -> None:
    assert "--objects: expected whole numbers >= 2" in refused("scaling --objects 1,5")

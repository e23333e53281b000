"""The estimators' benchmark in miniature: it measures what it says, and everybody is exact."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks.estimators import Vehicles, estimators
from benchmarks.flocks import Kind, flock
from saga_fg.estimators import IncrementalSmoother
from saga_fg.graph import OBJECT


@pytest.fixture(scope="module")
def rows() -> list[dict[str, Any]]:
    return [{"table": title, **row} for title, row in estimators("4,8", 2, 30.0, 4, 6)]


def test_every_exact_estimator_is_exact(rows) -> None:
    ours = [row for row in rows if row.get("estimator") in ("kalman", "isam2", "fixed-lag", "batch") and "case" in row]
    assert {(row["case"], row["estimator"]) for row in ours} == {
        *(("filter", "kalman"), ("filter", "isam2"), ("fixed lag", "fixed-lag"), ("batch", "batch")),
    }
    for row in ours:
        assert row["mean"] <= row["largest"] < 1e-8
        assert row.get("covariance", 0.0) < 1e-9


def test_ratios_are_those_of_the_times(rows) -> None:
    baselines = {"filter": "textbook", "batch": "textbook", "fixed lag": "GTSAM's", "running graph": "linear"}
    cases = [row for row in rows if "case" in row]
    for row in cases:
        same = [r for r in cases if all(r[key] == row[key] for key in ("case", "graph", "nodes"))]
        (base,) = [r for r in same if r["estimator"] == baselines[row["case"]]]
        assert row["ratio"] == pytest.approx(row["ms"] / base["ms"])
    drivers = {row["graph"] for row in cases if row["estimator"] == "intelligent driver"}
    assert drivers == {"connected", "components"}


def test_vehicles_drive_in_rows() -> None:
    vehicles = Vehicles(6, 3, linear=False)
    smoother = IncrementalSmoother([vehicles])
    for k in range(8):
        smoother.step(0.1 * k)
    there = smoother.graph().of(OBJECT, 7)
    places = np.stack([smoother.state(there[i].key)[:2] for i in range(6)])
    assert np.abs(places - vehicles.start[:, :2] - [5.6, 0.0]).max() < 2.0


def test_sizes_that_are_none_are_one_line_of_error(refused) -> None:
    for sizes in ("10,many", "1", ""):
        assert "--sizes: expected whole numbers >= 2" in refused("estimators --sizes", sizes)


def test_flocks_are_what_their_names_say() -> None:
    kind: Kind = "components"
    scene = flock(kind, 20, 3, seed=1)
    again = flock(kind, 20, 3, seed=1)
    for frame, same in zip(scene.frames, again.frames, strict=True):
        np.testing.assert_array_equal(frame.measurements.z, same.measurements.z)
        (edges,) = frame.transition.graph.edges
        assert np.bincount(edges.target, minlength=20).max() <= 4
        assert not (edges.target == edges.source).any()
    first, second = (frame.transition.graph.edges[0] for frame in scene.frames[:2])
    assert first.rate.tolist()[:5] != second.rate.tolist()[:5]

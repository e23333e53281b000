"""A tracker goes on from a snapshot as if nothing had happened in between."""

from __future__ import annotations

import numpy as np
import pytest

from saga_fg import Tracker, TrackerSettings
from tests.saga_fg.traffic_frames import run, seen, straight


def assert_same(a, b, tolerance):
    for x, y in zip(a, b, strict=True):
        assert x.timestamp == y.timestamp
        np.testing.assert_array_equal(x.id, y.id)
        np.testing.assert_allclose(x.boxes.position, y.boxes.position, rtol=0, atol=tolerance)
        np.testing.assert_allclose(x.position_covariance, y.position_covariance, rtol=0, atol=tolerance)
        np.testing.assert_allclose(x.score, y.score, rtol=0, atol=tolerance)


@pytest.mark.parametrize(("estimator", "tolerance"), [("kalman", 0.0), ("isam2", 1e-9), ("fixed-lag", 1e-9)])
def test_going_on_from_a_snapshot(estimator, tolerance):
    cars = straight([[0, 0], [12, 0], [24, 0], [0, 4]], [[10, 0], [10, 0], [10, 0], [6, 0]])
    frames = seen(np.random.default_rng(0), cars, np.arange(40) / 10)
    settings = TrackerSettings(estimator=estimator)
    tracker = Tracker(settings)
    run(tracker, frames[:20])
    snapshot = tracker.snapshot()
    expected = run(tracker, frames[20:])
    for again in (tracker, Tracker(settings), tracker):  # the same one, a fresh one, and once more
        again.restore(snapshot)
        assert_same(run(again, frames[20:]), expected, tolerance)
    assert any(len(tracks) for tracks in expected)

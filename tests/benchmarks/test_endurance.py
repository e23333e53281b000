"""The endurance benchmark in miniature: it measures what it says, and what it asks of trackers holds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks.endurance import EDGES, LONG, NONE, endurance, traffic_frame


@pytest.fixture(scope="module")
def rows() -> list[dict[str, Any]]:
    return [{"table": title, **row} for title, row in endurance(200, "kalman,fixed-lag", 60, 20, 0)]


def test_tracks_begin_and_end_all_the_time(rows: list[dict[str, Any]]) -> None:
    long = [row for row in rows if row["table"] == LONG]
    assert [(row["estimator"], row["frames"]) for row in long] == [("kalman", 200), ("fixed-lag", 50)]
    assert long[0]["tracks"] > 3 * long[0]["reported"] > 9
    assert all(row["files, last - second"] == 0 for row in long)


def test_after_a_day_of_nothing_tracks_are_those_of_a_fresh_tracker(rows: list[dict[str, Any]]) -> None:
    for row in (row for row in rows if row["table"] == NONE):
        assert row["apart"] < 0.01
        assert row["reported, old / fresh"] == pytest.approx(1.0, abs=0.02)


def test_nothing_is_lost_in_crowds_among_many_sensors_and_far_away(rows: list[dict[str, Any]]) -> None:
    found = {(row["case"], row["size"]): row["reported"] for row in rows if row["table"] == EDGES}
    assert (found["detections in a frame", 6], found["detections in a frame", 60]) == (6, 60)
    assert found["sensors", 1] == found["sensors", 20] > 3
    assert found["position, m", 0.0] == found["position, m", 9e8] > 3


def test_the_traffic_is_the_same_for_the_same_number() -> None:
    one, same, later = (traffic_frame(k, 0).detections.boxes.position for k in (7, 7, 8))
    np.testing.assert_array_equal(one, same)
    assert one.shape != later.shape or not np.array_equal(one, later)


def test_an_unknown_estimator_is_one_line(refused: Any) -> None:
    assert "--estimators: unknown name 'kalmann'; did you mean 'kalman'?" in refused(
        "endurance --estimators", "kalmann"
    )

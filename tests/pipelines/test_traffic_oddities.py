"""Recorded traffic that is odd: a vehicle in the middle of another, a lane that ends, lights nobody reports."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.config import load_config
from saga_fg import Boxes, Detections, Frame
from saga_fg.tracking import Tracker
from saga_fg.types.road_map import Lane, RoadMap, StopLine, TrafficLight

SIZE, SPEED = (4.5, 1.8, 1.5), 8.0


def frame(time: float, cars: list[tuple[float, float]], road: RoadMap | None = None) -> Frame:
    """Cars (x, y) that drive along x."""
    n = len(cars)
    position = np.column_stack([np.array(cars).reshape(-1, 2), np.zeros(n)])
    boxes = Boxes.of(["car"] * n, position, np.tile(SIZE, (n, 1)), np.zeros(n))
    return Frame(time, "lidar", Detections(boxes, np.full(n, 0.9)), road_map=road)


def new_tracker() -> Tracker:
    tracker = load_config("traffic").new_tracker("saga")
    assert isinstance(tracker, Tracker)
    return tracker


def test_a_vehicle_that_appears_in_the_middle_of_another_is_predicted_all_the_same(subtests: pytest.Subtests) -> None:
    for apart in [0.0, 1e-9, 0.5, 2.0]:
        with subtests.test(apart=apart):
            tracker = new_tracker()
            for k in range(20):
                x = SPEED * k / 10
                tracker.step(frame(k / 10, [(x, 0.0)] if k < 10 else [(x, 0.0), (x + apart, 0.0)]))
            predicted = tracker.predict([1.0, 5.0], joint=True)
            assert len(predicted) >= 1
            assert np.isfinite(predicted.position).all()
            assert (np.linalg.eigvalsh(predicted.position_covariance) > 0).all()
            assert predicted.joint_covariance is not None
            assert (np.linalg.eigvalsh(predicted.joint_covariance) > -1e-6).all()
            first = predicted.position[:, np.argmin(predicted.id), 0]
            assert SPEED * 1.9 < first[0] < first[1] < SPEED * 1.9 + 1.2 * SPEED * 5


def test_where_a_lane_ends_vehicles_are_predicted_straight_on() -> None:
    light = TrafficLight("light", (100.0, 5.0))
    line = StopLine("line", (100.0, 2.0), (100.0, -2.0), "light")
    ending = RoadMap((light,), (line,), (Lane("ending", ((-50.0, 0.0), (20.0, 0.0))),))
    tracker = new_tracker()
    for k in range(20):
        tracker.step(frame(k / 10, [(SPEED * k / 10, 0.0)], ending))
    predicted = tracker.predict([1.0, 3.0, 5.0])
    x, y = predicted.position[:, 0].T
    assert (np.diff(x) > 0).all()
    assert x[1] > 25  # beyond the end of the lane
    assert np.abs(y).max() < 1.0


def test_a_light_that_nobody_reports_stops_nobody_for_sure() -> None:
    """Colours are inferred from traffic: a car that comes at full speed 12 m before the line runs no red light."""
    light = TrafficLight("light", (40.0, 5.0))
    line = StopLine("line", (40.0, 2.0), (40.0, -2.0), "light")
    road = RoadMap((light,), (line,), (Lane("lane", ((-50.0, 0.0), (80.0, 0.0))),))
    tracker = new_tracker()
    for k in range(36):
        tracker.step(frame(k / 10, [(SPEED * k / 10, 0.0)], road))
    belief = tracker.map_nodes.belief("light")
    assert sum(belief.values()) == pytest.approx(1.0)
    assert belief["green"] > 0.5
    assert tracker.predict([3.0]).position[0, 0, 0] > 45


def test_traffic_without_a_map_has_no_nodes_of_one() -> None:
    tracker = new_tracker()
    for k in range(5):
        tracker.step(frame(k / 10, [(SPEED * k / 10, 0.0)]))
    assert len(tracker.map_nodes) == 0
    assert len(tracker.predict([1.0])) == 1

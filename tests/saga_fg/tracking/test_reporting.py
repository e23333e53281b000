"""Reported covariance of a position."""

import numpy as np
import pytest

from saga_fg import Sensor, Tracker, TrackerSettings
from saga_fg.model.sensor import NoiseModel
from tests.saga_fg.traffic_frames import NAN, frame, run


def told(noise, yaw=np.pi / 2, score=0.9):
    """The last tracks of a car by a sensor without and with settings of what is told."""
    frames = [frame(0.1 * k, [(0.0, 0.0)], yaw=yaw, score=score) for k in range(20)]
    return [
        run(Tracker(TrackerSettings(edges=()), {"lidar": Sensor({"default": model})}), frames)[-1]
        for model in (NoiseModel(), noise)
    ]


def test_the_error_that_all_detections_share_is_along_the_heading_and_not_filtered():
    plain, car = told(NoiseModel(position_bias=0.3, position_bias_growth=2.0))
    np.testing.assert_array_equal(car.boxes.position, plain.boxes.position)
    added = car.position_covariance[0] - plain.position_covariance[0]
    assert added == pytest.approx(np.diag([0.0, (0.3 * (1 + 2.0 * 0.1)) ** 2]), abs=1e-6)


def test_a_bias_of_unknown_direction_is_the_same_in_all():
    plain, car = told(NoiseModel(position_bias=0.3), yaw=NAN)
    assert car.position_covariance[0] - plain.position_covariance[0] == pytest.approx(0.045 * np.eye(2))


@pytest.mark.parametrize("score", [0.3, 0.9])
def test_the_scale_changes_what_is_told_and_nothing_else(score):
    plain, car = told(NoiseModel(reported_deviation_scale=0.5, reported_low_score_growth=1.0), score=score)
    factor = 0.5 * (1 + (1 - score))
    assert car.position_covariance[0] == pytest.approx(factor**2 * plain.position_covariance[0])
    for name in ("position", "velocity", "yaw"):
        np.testing.assert_array_equal(getattr(car.boxes, name), getattr(plain.boxes, name))
    np.testing.assert_array_equal(car.velocity_covariance, plain.velocity_covariance)


def test_what_is_told_is_that_of_the_sensor_of_the_latest_detection():
    sensors = {"lidar": Sensor(), "camera": Sensor({"default": NoiseModel(position_bias=2.0)})}
    tracker = Tracker(TrackerSettings(edges=()), sensors)
    largest = [
        tracker.step(frame(0.1 * k, [(0.0, 0.0)], sensor=sensor)).position_covariance[0].max()
        for k, sensor in enumerate(("lidar", "camera", "lidar"))
    ]
    assert [value > 3 for value in largest] == [False, True, False]

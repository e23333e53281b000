"""A sensor's model: noise along and across the line of sight, field of view, extrinsics, scores."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg import Boxes, Detections, InputError, Sensor
from saga_fg.model.sensor import Extrinsics, FieldOfView, NoiseModel, ScoreCalibration
from saga_fg.numerics.geometry import transform_points, yaw_transform

metres = st.floats(-200, 200)


def labels(*names):
    return np.array(names, dtype=np.str_)


def covariance(noise, position, probability=1.0, origin=(0.0, 0.0), label="car"):
    sensor = Sensor(noise={"default": noise})
    return sensor.position_covariance(labels(label), np.array([position]), np.array([probability]), np.array(origin))[0]


# noise


def test_noise_along_and_across_the_line_of_sight():
    noise = NoiseModel(position=0.1, range_noise=0.01, bearing_noise=0.002)
    ahead = covariance(noise, (50.0, 0.0))
    assert ahead == pytest.approx(np.diag([0.1**2 + 0.5**2, 0.1**2 + 0.1**2]))
    left = covariance(noise, (0.0, 50.0))
    assert left == pytest.approx(np.diag([0.1**2 + 0.1**2, 0.1**2 + 0.5**2]))


@given(metres, metres, st.tuples(metres, metres), st.floats(0.01, 1), st.floats(0, 0.1), st.floats(0, 0.1))
def test_the_covariance_formula(x, y, origin, position, range_noise, bearing_noise):
    offset = np.array([x, y]) - origin
    r = np.linalg.norm(offset)
    R = covariance(NoiseModel(position, range_noise, bearing_noise), (x, y), origin=origin)
    assert np.array_equal(R, R.T)
    if r > 1e-3:
        u = offset / r
        n = np.array([-u[1], u[0]])
        assert u @ R @ u == pytest.approx(position**2 + (range_noise * r) ** 2)
        assert n @ R @ n == pytest.approx(position**2 + (bearing_noise * r) ** 2)
        assert u @ R @ n == pytest.approx(0, abs=1e-9 * np.trace(R))
    else:
        assert np.allclose(R, position**2 * np.eye(2), rtol=1e-3)


def test_at_the_sensors_own_place_there_is_no_direction():
    assert covariance(NoiseModel(0.3, 0.1, 0.1), (0.0, 0.0)) == pytest.approx(0.09 * np.eye(2))


def test_deviations_grow_as_the_score_falls():
    noise = NoiseModel(position=0.2, low_score_growth=1.5)
    assert covariance(noise, (5.0, 0.0), probability=1.0) == pytest.approx(0.04 * np.eye(2))
    assert covariance(noise, (5.0, 0.0), probability=0.4) == pytest.approx((0.2 * (1 + 1.5 * 0.6)) ** 2 * np.eye(2))
    sensor = Sensor(noise={"default": NoiseModel(velocity=0.5, low_score_growth=1.0)})
    seen = Detections(Boxes.of(["car", "car"], np.zeros((2, 3))), np.ones(2))
    velocity = sensor.detection_covariance(seen, None, np.array([1.0, 0.5]))[:, 2:, 2:]
    assert velocity == pytest.approx(np.stack([0.25 * np.eye(2), (0.5 * 1.5) ** 2 * np.eye(2)]))


def test_each_class_has_its_noise_and_the_default_serves_all_others():
    sensor = Sensor(noise={"car": NoiseModel(position=1.0), "default": NoiseModel(position=2.0)})
    assert sensor.deviations(labels("bus", "car", "bus"), "position").tolist() == [[2.0, 1.0, 2.0]]
    assert Sensor(noise={"car": NoiseModel()}).deviations(labels("bus"), "position").tolist() == [[0.3]]
    assert sensor.deviations(labels(), "position", "yaw").shape == (2, 0)
    none = np.empty((0, 2))
    assert sensor.position_covariance(labels(), none, np.empty(0), np.zeros(2)).shape == (0, 2, 2)


# scores


@given(st.floats(-1e300, 1e300))
def test_probabilities_are_never_certain(score):
    for kind in ("probability", "logit"):
        p = Sensor(score=kind).probability(np.array([score]), labels("car"))[0]
        assert 1e-3 <= p <= 1 - 1e-3


def test_scores_are_probabilities_or_logits():
    assert Sensor().probability(np.array([0.25]), labels("car")) == pytest.approx([0.25])
    logits = np.array([-2.0, 0.0, 1.5])
    assert Sensor(score="logit").probability(logits, labels("a", "a", "b")) == pytest.approx(1 / (1 + np.exp(-logits)))


def test_calibration_is_straight_on_the_logit_class_by_class():
    calibration = {"car": ScoreCalibration(slope=2.0, offset=-1.0), "default": ScoreCalibration(offset=0.5)}
    sensor = Sensor(calibration=calibration)
    p = sensor.probability(np.array([0.7, 0.7]), labels("car", "bus"))
    logit = np.log(0.7 / 0.3)
    assert np.log(p / (1 - p)) == pytest.approx([2 * logit - 1, logit + 0.5])


def test_classes_differ_in_their_chance_of_detection():
    sensor = Sensor(detection_probability=0.8, class_detection_probability={"pedestrian": 0.5})
    assert sensor.detection_chance(labels("car", "pedestrian")).tolist() == [0.8, 0.5]
    with pytest.raises(InputError, match=r"class_detection_probability\.car: expected a number from 0 to 1"):
        Sensor(class_detection_probability={"car": 1.5})


# field of view


def test_without_a_pose_everything_may_be_seen():
    assert Sensor().sees(np.array([[1e6, 0.0]]), None).tolist() == [True]


@given(metres, metres, st.floats(-7, 7), st.floats(-3, 3), st.floats(-0.95, 0.95), st.floats(1, 79))
def test_the_field_of_view_turns_with_vehicle_and_mount(x, y, yaw, mount_yaw, azimuth, distance):
    view = FieldOfView(min_azimuth=-0.5, max_azimuth=0.7, max_range=40.0)
    sensor = Sensor(field_of_view=view, extrinsics=Extrinsics(x=1.5, y=-0.3, z=1.2, yaw=mount_yaw))
    world_T_ego = yaw_transform(x, y, 0.5, yaw)
    in_sensor = distance * np.array([[np.cos(azimuth), np.sin(azimuth), 0.0]])
    in_world = transform_points(world_T_ego @ sensor.extrinsics.ego_T_sensor, in_sensor)[:, :2]
    margin = min(abs(azimuth + 0.5), abs(azimuth - 0.7), abs(distance - 40))
    if margin > 1e-6:
        assert sensor.sees(in_world, world_T_ego).tolist() == [-0.5 <= azimuth <= 0.7 and distance <= 40]


def test_a_rear_sensor_sees_across_the_seam():
    sensor = Sensor(field_of_view=FieldOfView(min_azimuth=3 * np.pi / 4, max_azimuth=5 * np.pi / 4))
    behind = np.array([[-10.0, 0.1], [-10.0, -0.1], [-10.0, 9.0], [-10.0, 11.0], [10.0, 0.0]])
    assert sensor.sees(behind, np.eye(4)).tolist() == [True, True, True, False, False]


def test_all_round_means_all_round():
    around = 20 * np.stack([np.cos(np.linspace(-4, 4, 50)), np.sin(np.linspace(-4, 4, 50))], axis=-1)
    assert Sensor().sees(around, np.eye(4)).all()


def test_extrinsics_are_finite(subtests):
    for key in ["x", "y", "z", "yaw"]:
        for value in [float("nan"), float("inf"), -float("inf")]:
            with (
                subtests.test(key=key, value=value),
                pytest.raises(InputError, match=f"^{key}: expected a finite number, got"),
            ):
                Extrinsics(**{key: value})

"""Noise told by successive detections: it is found whatever the motion, and scales gates, ellipses and labels."""

import numpy as np
import pytest

from saga_fg import Boxes, Detections, Frame, Sensor, Tracker, TrackerSettings
from saga_fg.tracking.sensor_noise import LEAST, MOST, SensorNoise, scaled_sensors

MODEL = 0.3  # m
TABLE = {"default": Sensor(calibrate_noise=True)}


def taken(noise, time, position, label="car", distance=0.0):
    n = len(position)
    R = np.tile(MODEL**2 * np.eye(2), (n, 1, 1))
    return noise.observed(time, np.arange(n), position, R, np.resize(label, n), np.resize(distance, n))


def seen(sigma, motion, rng, frames=60, objects=8, jitter=0.0):
    """The noise after frames of objects that move by `motion(t)` (2,), with white errors."""
    noise, time = SensorNoise(), 0.0
    start = rng.uniform(-50, 50, (objects, 2))
    for _ in range(frames):
        time += 0.1 + rng.uniform(-jitter, jitter)
        position = start + motion(time) + rng.normal(0, sigma, (objects, 2))
        noise = taken(noise, time, position)
    return noise


@pytest.mark.parametrize("sigma", [0.15, 0.3, 0.9])
@pytest.mark.parametrize("jitter", [0.0, 0.04])
def test_noise_is_found_whatever_the_motion_and_the_steps(sigma, jitter):
    rng = np.random.default_rng(0)
    standing = seen(sigma, lambda t: np.zeros(2), rng, jitter=jitter)
    braking = seen(sigma, lambda t: np.array([20 * t - 2 * t**2, 0.5 * t]), rng, jitter=jitter)
    assert standing.scale == pytest.approx(sigma / MODEL, rel=0.15)
    assert braking.scale == pytest.approx(sigma / MODEL, rel=0.15)


def test_the_scale_stays_within_bounds_and_waits_for_evidence():
    rng = np.random.default_rng(1)
    assert SensorNoise().scale == 1.0
    assert seen(0.1, lambda t: np.zeros(2), rng).scale == pytest.approx(LEAST, rel=0.15)
    assert seen(0.03, lambda t: np.zeros(2), rng).scale == 1.0
    assert seen(5.0, lambda t: np.zeros(2), rng).scale == pytest.approx(MOST)
    assert seen(0.3, lambda t: np.zeros(2), rng, frames=2, objects=5).scale == 1.0


def test_motion_never_passes_for_noise_while_little_is_known():
    rng = np.random.default_rng(2)
    for frames in range(5, 12):
        assert seen(0.3, lambda t: np.array([20 * t, 0.0]), rng, frames, objects=40).scale <= 1.15


def test_large_noise_is_found_within_half_a_second():
    for motion in (np.zeros(2), np.array([20.0, 0.0])):
        noise = seen(0.9, lambda t, v=motion: t * v, np.random.default_rng(6), frames=5, objects=20)
        assert noise.scale == pytest.approx(3.0, rel=0.2)


def test_the_scale_stays_after_the_first_seconds():
    rng = np.random.default_rng(3)
    noise = seen(0.15, lambda t: np.zeros(2), rng, frames=120)
    later = taken(noise, 60.0, rng.normal(0, 9, (8, 2)))
    assert noise.settled
    assert later.scale == noise.scale == pytest.approx(0.5, rel=0.2)
    assert later.seen == noise.seen > 0


def test_noise_is_found_by_class_and_range():
    rng, noise = np.random.default_rng(4), SensorNoise()
    label, distance = np.repeat(["bus", "car", "car", "car"], 6), np.repeat([15.0, 12.0, 30.0, 55.0], 6)
    sigma = np.where(label == "bus", 0.6, np.hypot(0.15, 0.01 * distance))
    start = rng.uniform(-50, 50, (len(label), 2))
    for k in range(95):
        noise = taken(noise, 0.1 * k, start + 0.8 * k + rng.normal(0, sigma[:, None], start.shape), label, distance)
    found = noise.scales(label, distance)
    np.testing.assert_allclose(found, sigma / MODEL, rtol=0.25)
    rare = noise.scales(np.array(["van"]), np.array([40.0]))
    assert rare == pytest.approx([noise.scale])
    assert found.min() < noise.scale < found.max()


def test_noise_that_grows_fast_stays_within_its_bounds_at_all_ranges():
    rng, noise = np.random.default_rng(6), SensorNoise()
    distance = np.repeat([8.0, 26.0, 55.0], 8)
    sigma = np.maximum(0.08, 4e-4 * distance**2)
    start = rng.uniform(-50, 50, (len(distance), 2))
    for k in range(95):
        noise = taken(noise, 0.1 * k, start + rng.normal(0, sigma[:, None], start.shape), "car", distance)
    near, _, far = noise.scales(np.resize("car", 3), np.array([0.0, 40.0, 900.0]))
    assert LEAST <= near < noise.scale < far == pytest.approx(MOST)
    model = scaled_sensors({}, {"table": noise})["table"].noise["car"]
    assert model.position == pytest.approx(near * Sensor().noise["default"].position)
    assert model.range_noise == model.bearing_noise > 0


def frames(sigma, count=80, seed=0, **columns):
    rng = np.random.default_rng(seed)
    start = np.stack([15.0 * np.arange(6), 4.0 * np.arange(6)], axis=1)
    for k in range(count):
        truth = start + np.array([8.0, 0.5]) * 0.1 * k
        position = np.column_stack([truth + rng.normal(0, sigma, truth.shape), np.zeros(6)])
        boxes = Boxes.of(np.full(6, "car"), position, np.tile((4.0, 2.0, 1.5), (6, 1)), np.zeros(6))
        yield Frame(0.1 * k, "table", Detections(boxes, np.full(6, 0.9), **columns)), truth


@pytest.mark.parametrize("sigma", [0.1, 1.0])
def test_ellipses_of_a_table_hold_what_they_say(sigma):
    held, tracker = [], Tracker(TrackerSettings(min_hits=2), TABLE)
    for seed in range(3):
        tracker = Tracker(TrackerSettings(min_hits=2), TABLE)
        for frame, truth in frames(sigma, seed=seed):
            tracks = tracker.step(frame)
            if frame.timestamp < 3.0:  # until then little is known
                continue
            apart = tracks.boxes.position[:, None, :2] - truth
            error = apart[np.arange(len(tracks)), np.linalg.norm(apart, axis=2).argmin(axis=1)]
            d2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(tracks.position_covariance), error)
            held += (d2 < 4.605).tolist()
    assert 0.82 < np.mean(held) < 0.97
    assert tracker.sensor_noise["table"].scale == pytest.approx(sigma / MODEL, rel=0.25)


def test_noise_that_comes_with_the_detections_stays_as_it_is():
    given = np.tile(0.3**2 * np.eye(2), (6, 1, 1))
    with_scale, without = Tracker(TrackerSettings(), TABLE), Tracker(TrackerSettings())
    for frame, _ in frames(1.0, position_covariance=given):
        a, b = with_scale.step(frame), without.step(frame)
        np.testing.assert_array_equal(a.position_covariance, b.position_covariance)
    assert with_scale.sensor_noise == {}


def test_models_are_scaled_in_positions_alone():
    noise = SensorNoise(2.0, {"car": (1.5, 0.1)})
    scaled = scaled_sensors({}, {"table": noise})["table"]
    usual = Sensor().noise["default"]
    others = scaled.noise["default"]
    assert (others.position, others.velocity, others.yaw) == (2 * usual.position, usual.velocity, usual.yaw)
    at = np.array([[0.0, 0.0], [3.0, 4.0]])
    R = scaled.position_covariance(np.array(["car", "car"]), at, np.ones(2), np.zeros(2))
    s = noise.scales(np.array(["car", "car"]), np.array([0.0, 5.0]))
    np.testing.assert_allclose(R, (s * usual.position)[:, None, None] ** 2 * np.eye(2), atol=1e-12)

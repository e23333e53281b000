"""Learned sensors equal those that the data were sampled from, within the tolerance that their number allows."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from saga_fg import Annotations, Boxes, Detections, Frame, InputError, Scene, Sensor
from saga_fg.learning import (
    DetectionSample,
    SampledDetections,
    SampledObjects,
    fit_position_noise,
    fit_score_calibration,
    fit_sensor,
    match_to_truth,
    sample_with_truth,
)
from saga_fg.learning.sensor_fit import fit_field_of_view
from saga_fg.model.sensor import Extrinsics, FieldOfView, NoiseModel, ScoreCalibration


def errors(rng, noise, n, wrong=0.0, gate=4.0):
    """Errors along and across, ranges and probabilities of n detections, a share of which are matched wrongly."""
    r, p = rng.uniform(3, 50, n), rng.uniform(0.2, 1.0, n)
    f = 1 + noise.low_score_growth * (1 - p)
    along = f * np.hypot(noise.position, noise.range_noise * r) * rng.standard_normal(n)
    across = f * np.hypot(noise.position, noise.bearing_noise * r) * rng.standard_normal(n)
    stray = rng.random(n) < wrong
    return np.where(stray, rng.uniform(-gate, gate, n), along), np.where(stray, rng.uniform(-2, 2, n), across), r, p


CAMERA = NoiseModel(position=0.15, range_noise=0.035, bearing_noise=0.005, low_score_growth=0.5)
LIDAR = NoiseModel(position=0.08, range_noise=0.004, bearing_noise=0.003, low_score_growth=1.0)


@pytest.mark.parametrize(("noise", "wrong"), [(CAMERA, 0.1), (LIDAR, 0.0)], ids=["camera", "lidar"])
def test_noise_is_found_again_whether_or_not_some_matches_are_wrong(noise, wrong):
    along, across, r, p = errors(np.random.default_rng(0), noise, 3000, wrong)
    found = fit_position_noise(along, across, r, p, gate=4.0)
    at = np.array([10.0, 25.0, 45.0])
    for name in ("range_noise", "bearing_noise"):
        sigma, true = (np.hypot(model.position, getattr(model, name) * at) for model in (found, noise))
        assert sigma == pytest.approx(true, rel=0.1)
    assert found.low_score_growth == pytest.approx(noise.low_score_growth, abs=0.2)


def test_no_error_tells_nothing():
    none = np.empty(0)
    with pytest.raises(InputError, match="at least one error"):
        fit_position_noise(none, none, none, none, gate=4.0)


@settings(max_examples=20, deadline=None)
@given(st.floats(0.5, 3.0), st.floats(-2.0, 2.0), st.integers(0, 1000))
def test_the_calibration_of_scores_is_found_again(slope, offset, seed):
    rng = np.random.default_rng(seed)
    s = rng.normal(0.0, 1.5, 4000)
    true = rng.random(4000) < 1 / (1 + np.exp(-(offset + slope * s)))
    found = fit_score_calibration(s, true)
    assert found.slope == pytest.approx(slope, abs=0.4)
    assert found.offset == pytest.approx(offset, abs=0.4)


def test_scores_that_separate_all_there_is_give_a_finite_calibration():
    found = fit_score_calibration(np.array([-1.0, 1.0]), np.array([False, True]))
    assert 1.0 < found.slope < 3.0
    prior = ScoreCalibration(slope=2.0, offset=-1.0)
    assert fit_score_calibration(np.empty(0), np.empty(0, dtype=bool), prior) == prior


def detections_at(azimuth, distance=None):
    """Detections of one class whose errors are not known."""
    n = len(azimuth)
    distance = np.zeros(n) if distance is None else distance
    return SampledDetections.without_errors(np.full(n, "car"), np.zeros(n), distance, azimuth, np.zeros(n, dtype=bool))


def test_detection_probability_is_the_share_of_chances_taken():
    detected = np.concatenate([np.arange(400) % 4 > 0, np.zeros(5, dtype=bool)])
    objects = SampledObjects(np.repeat(["car", "bus"], [400, 5]), np.full(405, 20.0), np.zeros(405), detected)
    model = fit_sensor(DetectionSample(detections_at(np.empty(0)), objects), Sensor(), gate=4.0)
    assert model.class_detection_probability["car"] == pytest.approx(0.75, abs=0.01)
    assert "bus" not in model.class_detection_probability  # seldom in view: the share of all classes serves
    assert model.noise == Sensor().noise


def test_where_a_sensor_never_detects_anything_it_does_not_look():
    rng = np.random.default_rng(5)
    sample = detections_at(rng.uniform(2.5, 4.5, 1000), rng.uniform(2.0, 40.0, 1000))
    view = fit_field_of_view(sample, FieldOfView())
    assert (view.min_azimuth, view.max_azimuth) == pytest.approx((2.5, 4.5), abs=0.02)
    assert view.max_range == pytest.approx(40.8, abs=0.5)
    assert (
        fit_field_of_view(replace(sample, azimuth=rng.uniform(-np.pi, np.pi, 1000)), FieldOfView()).max_azimuth == np.pi
    )
    known = FieldOfView(-1.0, 1.0, 50.0)
    assert fit_field_of_view(sample, known) == known


def recording():
    """A car that drives away and a person who stands, seen half a second later by a sensor off the vehicle's centre."""
    truth = [
        Annotations(
            np.array(["a", "b"]),
            Boxes.of(["car", "pedestrian"], [[20.0 + 10 * k, 0, 1], [5.0, 5.0, 1]], yaw=[0.0, 0.0]),
            np.array([True, True]),
        )
        for k in range(2)
    ]
    seen = Boxes.of(["car", "bus"], [[22.5, 1.4, 1.2], [2.0, 4.0, 1.0]], yaw=[np.pi, 0.0])
    frame = Frame(0.5, "camera", Detections(seen, np.array([0.8, 0.5])), np.eye(4), "sensor")
    return Scene("two", np.array([0.0, 1.0]), np.tile(np.eye(4), (2, 1, 1)), ("", ""), (frame,), tuple(truth))


def test_detections_are_compared_with_the_truth_of_their_own_time():
    sensor = Sensor(extrinsics=Extrinsics(x=3.0, y=-1.0))
    (matched,) = match_to_truth(recording(), {"camera": sensor})
    assert matched.annotations.boxes.position[:, 0].tolist() == [25.0, 5.0]  # half way
    assert (matched.detection.tolist(), matched.truth.tolist()) == ([0], [0])
    sample, objects = sample_with_truth([recording()], {"camera": sensor})["camera"]
    assert sample.true.tolist() == [True, False]
    sight = np.array([22.5, 1.4]) / np.hypot(22.5, 1.4)
    assert sample.along[0] == pytest.approx(np.array([0.5, 0.4]) @ sight)
    assert sample.across[0] == pytest.approx(np.array([0.5, 0.4]) @ [-sight[1], sight[0]])
    assert sample.height[0] == pytest.approx(0.2)
    assert sample.yaw[0] == pytest.approx(0.0, abs=1e-12)  # half a turn counts as none
    assert objects.detected.tolist() == [True, False]


def test_without_annotations_there_is_no_truth():
    scene = recording()
    with pytest.raises(InputError, match="scene two: expected ground truth"):
        sample_with_truth([replace(scene, ground_truth=None)], {})

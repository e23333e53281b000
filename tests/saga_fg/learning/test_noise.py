"""Noise that is learned: of motion and of sensors."""

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from saga_fg import (
    Annotations,
    Boxes,
    ConstantVelocity,
    Curvilinear,
    Detections,
    Frame,
    InputError,
    NodeType,
    Scene,
    SceneGraph,
    Sensor,
)
from saga_fg.estimators import Gaussian, kalman_predict, kalman_update
from saga_fg.learning import (
    DetectionSample,
    HiddenObjects,
    MeasuredTrajectory,
    SampledDetections,
    SampledObjects,
    fit_acceleration_noise,
    fit_curvilinear,
    fit_curvilinear_by_class,
    fit_position_noise,
    fit_score_calibration,
    fit_sensor,
    hidden_objects,
    match_to_truth,
    sample_with_truth,
)
from saga_fg.learning import process_noise as learning
from saga_fg.learning.hidden_objects import STEP
from saga_fg.learning.process_noise import CurvilinearLikelihood, log_likelihood
from saga_fg.learning.sensor_fit import fit_field_of_view
from saga_fg.model.discretisation import discretise
from saga_fg.model.edge_rules import Following, Neighbours, Repulsion
from saga_fg.model.interactions import SharedVelocity
from saga_fg.model.manoeuvres import KnownCourses, Mixture
from saga_fg.model.sensor import Extrinsics, FieldOfView, NoiseModel, ScoreCalibration
from saga_fg.tracking import ClassSettings, Tracker, TrackerSettings
from tests.saga_fg.following_pairs import following_pairs, scene_of


def drawn(rng, acceleration_noise, count=40, length=30, noise=0.2):
    """Objects that move as the model says, seen at irregular times with known noise."""
    car = NodeType("car", ConstantVelocity(acceleration_noise))
    objects = []
    for _ in range(count):
        x, time, times, seen = rng.normal(size=4) * 5, 0.0, [], []
        for _ in range(int(rng.integers(3, length))):
            dt = float(rng.uniform(0.05, 0.6))
            step = discretise(SceneGraph.of([0], car), dt)
            x = step.F_matrix @ x + np.linalg.cholesky(step.Q_matrix.toarray()) @ rng.normal(size=4)
            time += dt
            times.append(time)
            seen.append(x[:2] + noise * rng.normal(size=2))
        objects.append(
            MeasuredTrajectory(np.array(times), np.array(seen), np.tile(noise**2 * np.eye(2), (len(seen), 1, 1)))
        )
    return objects


def by_the_book(objects, acceleration_noise, initial_speed_deviation):
    car, H, total = NodeType("car", ConstantVelocity(acceleration_noise)), np.eye(2, 4), 0.0
    for o in objects:
        P = np.diag([0.0, 0.0, initial_speed_deviation**2, initial_speed_deviation**2])
        P[:2, :2] = o.R[0]
        x = Gaussian(np.concatenate([o.position[0], [0, 0]]), P)
        for k in range(1, len(o)):
            step = discretise(SceneGraph.of([0], car), o.time[k] - o.time[k - 1])
            x = kalman_predict(x, step.F_matrix.toarray(), step.b, step.Q_matrix.toarray())
            x, log_density = kalman_update(x, o.position[k], H, o.R[k])
            total += log_density
    return total


def test_likelihoods_are_those_of_a_textbook_filter_an_object_seen_often_enough():
    objects = drawn(np.random.default_rng(0), 1.5, count=8)
    assert log_likelihood(objects, 0.7, 4.0) == pytest.approx(by_the_book(objects, 0.7, 4.0), rel=1e-9)
    assert log_likelihood(objects[::-1], 0.7, 4.0) == pytest.approx(log_likelihood(objects, 0.7, 4.0), rel=1e-12)
    seldom = MeasuredTrajectory(np.array([0.0, 1.0]), np.zeros((2, 2)), np.tile(np.eye(2), (2, 1, 1)))
    for objects in ([], [seldom]):
        with pytest.raises(InputError, match="objects: expected at least one object seen three times or more"):
            fit_acceleration_noise(objects)


@pytest.mark.parametrize("truth", [0.05, 8.0])
def test_the_noise_of_the_model_is_found_again(truth):
    fitted = fit_acceleration_noise(drawn(np.random.default_rng(1), truth), initial_speed_deviation=5.0)
    assert fitted == pytest.approx(truth, rel=0.3)


def test_a_long_trajectory_is_cut_into_pieces_of_about_one_length():
    one = MeasuredTrajectory(np.arange(25.0), np.zeros((25, 2)), np.tile(np.eye(2), (25, 1, 1)))
    pieces = one.pieces(10)
    assert [len(piece) for piece in pieces] == [9, 8, 8]
    assert np.concatenate([piece.time for piece in pieces]).tolist() == one.time.tolist()


# Curvilinear motion from data: the likelihood is the textbook filter's, and what is learned holds on other objects

DT, NOISE, YAW_NOISE = 0.1, 0.1, 0.01
TRUTH = Curvilinear(acceleration_noise=0.3, lateral_acceleration_noise=0.02, jerk_noise=0.5, fading_time=2.0)


def curvilinear_drawn(rng, motion, count, moments=60):
    """Vehicles that drive along the motion's own courses, straight on, seen with known noise."""
    car, objects = NodeType("car", motion), []
    for _ in range(count):
        heading = rng.uniform(-np.pi, np.pi)
        u = np.array([np.cos(heading), np.sin(heading)])
        x = np.concatenate([rng.normal(size=2), 25 * u, np.zeros(2)])
        seen = []
        for _ in range(moments):
            straight = np.array([heading]), np.zeros(1), np.zeros(1)
            record = KnownCourses.from_turn_rates(car, np.array([0]), *straight, x[None], DT)
            step = discretise(replace(SceneGraph.of([0], car), motions=(record,)), DT)
            x = step.F_matrix @ x + step.b + rng.multivariate_normal(np.zeros(6), step.Q_matrix.toarray())
            seen.append(x[:2] + NOISE * rng.normal(size=2))
        R = np.tile(NOISE**2 * np.eye(2), (moments, 1, 1))
        yaw = heading + YAW_NOISE * rng.normal(size=moments)
        objects.append(MeasuredTrajectory(DT * np.arange(moments), np.array(seen), R, yaw, np.full(moments, YAW_NOISE)))
    return objects


def test_without_headings_the_loss_is_that_of_one_textbook_filter_an_object(monkeypatch):
    """With ever more degrees of freedom Student's t is the normal distribution."""
    monkeypatch.setattr(learning, "TAILS", 1e9)
    rng, car, H = np.random.default_rng(0), NodeType("car", TRUTH), np.eye(2, 6)
    objects = [
        MeasuredTrajectory(
            np.cumsum(rng.uniform(0.05, 0.3, k)).round(3), rng.normal(size=(k, 2)), np.tile(np.eye(2), (k, 1, 1))
        )
        for k in (4, 6, 3)
    ]
    densities = []
    for one in objects:
        P = np.diag([1.0, 1.0, *[learning.INITIAL_SPEED_DEVIATION**2] * 2, 1.0, 1.0])
        x = Gaussian(np.concatenate([one.position[0], np.zeros(4)]), P)
        for k in range(1, len(one)):
            step = discretise(SceneGraph.of([0], car), one.time[k] - one.time[k - 1])
            x = kalman_predict(x, step.F_matrix.toarray(), step.b, step.Q_matrix.toarray())
            x, log_density = kalman_update(x, one.position[k], H, one.R[k])
            densities.append(log_density + np.log(2 * np.pi))
    assert CurvilinearLikelihood.from_trajectories(objects).loss(TRUTH) == pytest.approx(-np.mean(densities), rel=1e-6)


def test_what_is_learned_is_near_the_truth_and_better_on_other_objects(monkeypatch):
    monkeypatch.setattr(learning, "EVALUATIONS", 20)
    rng = np.random.default_rng(1)
    start = replace(TRUTH, acceleration_noise=3.0, jerk_noise=0.05)
    learned = fit_curvilinear(curvilinear_drawn(rng, TRUTH, 30, moments=40), start)
    others = CurvilinearLikelihood.from_trajectories(curvilinear_drawn(rng, TRUTH, 30, moments=40))
    assert others.loss(learned) < (others.loss(start) + others.loss(TRUTH)) / 2
    assert TRUTH.acceleration_noise / 2 < learned.acceleration_noise < start.acceleration_noise / 1.5


def test_too_few_objects_teach_nothing_and_only_their_own_classes(monkeypatch):
    objects = curvilinear_drawn(np.random.default_rng(2), TRUTH, 3, moments=20)
    assert fit_curvilinear(objects, TRUTH) == TRUTH
    assert fit_curvilinear([], TRUTH) == TRUTH
    monkeypatch.setattr(learning, "EVALUATIONS", 10)
    start = replace(TRUTH, acceleration_noise=5.0)
    objects = {"car": curvilinear_drawn(np.random.default_rng(3), TRUTH, 24, moments=25)}
    learned = fit_curvilinear_by_class(objects, lambda _: start)
    assert list(learned) == ["default"], "one class needs no motion of its own"
    assert learned["default"].acceleration_noise < 5.0
    assert fit_curvilinear_by_class(objects, lambda _: ConstantVelocity()) == {}


# Learned sensors equal those that the data were sampled from, within the tolerance that their number allows


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


def test_without_errors_or_annotations_nothing_is_told():
    none = np.empty(0)
    with pytest.raises(InputError, match="at least one error"):
        fit_position_noise(none, none, none, none, gate=4.0)
    scene = recording()
    with pytest.raises(InputError, match="scene two: expected ground truth"):
        sample_with_truth([replace(scene, ground_truth=None)], {})


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


# Hidden objects are predicted by the tracker's own step

SENSORS = {"default": Sensor(noise={"default": NoiseModel(position=0.02, yaw=0.02)})}
ONCE = 1.5  # s
FOLLOW = Following(SharedVelocity(), rate=0.5, gap_scale=20.0)


def settings_of(motion):
    classes = {"default": ClassSettings(motion=motion, initial_speed_deviation=8.0, max_distance=20.0)}
    return TrackerSettings(classes=classes, edges=(), stationary_share=0.2)


VELOCITY = settings_of(ConstantVelocity(1.0))
FADING = settings_of(Curvilinear(fading_time=1.0, turn_time=2.0))


def turning(moments=60):
    """Three cars on a circle, which are seen to turn."""
    t = 0.1 * np.arange(moments)[:, None]
    angle = t * 0.3 + 0.4 * np.arange(3)
    position = np.stack([30 * np.sin(angle), -30 * np.cos(angle), 0 * angle], axis=-1)
    scene = scene_of(position)
    frames, truth = [], []
    for k, frame in enumerate(scene.frames):
        boxes = dataclasses.replace(frame.detections.boxes, yaw=angle[k])
        frames.append(dataclasses.replace(frame, detections=dataclasses.replace(frame.detections, boxes=boxes)))
        truth.append(dataclasses.replace(scene.ground_truth[k], boxes=boxes))
    return dataclasses.replace(scene, frames=frames, ground_truth=truth)


GAINED = (dataclasses.replace(FOLLOW, information_gain=True), Neighbours(rate=0.4))


@pytest.mark.parametrize(
    ("scene", "settings", "rules"),
    [
        (following_pairs(pairs=2, moments=60), VELOCITY, (FOLLOW,)),
        (following_pairs(pairs=2, moments=60), FADING, GAINED),
        (turning(), FADING, ()),
        (turning(), VELOCITY, GAINED),
    ],
    ids=["following", "by information gain", "turning alone", "turning by gain"],
)
def test_the_first_step_is_that_of_a_tracker_with_the_same_settings_and_rules(scene, settings, rules):
    sample = hidden_objects(scene, settings, SENSORS, ONCE)
    found = sample.predict(settings, rules)
    kf = Tracker(settings, SENSORS)
    compared = 0
    for frame in scene.frames:
        kf.step(frame)
        tracker = Tracker(dataclasses.replace(settings, edges=rules), SENSORS)
        tracker.restore(kf.snapshot())
        later = tracker.tracks(frame.timestamp + STEP)
        present = tracker.tracks(frame.timestamp)
        for w in range(len(sample)):
            start = sample.recorded.tracks.mean[sample.start[w], :2]
            row = np.flatnonzero(np.hypot(*(present.boxes.position[:, :2] - start).T) < 1e-9)
            if len(row) and np.isfinite(found.position[w, 0, 0]):
                then = later.boxes.position[later.id == present.id[row[0]], :2]
                np.testing.assert_allclose(found.position[w, :1], then, atol=1e-6)
                compared += 1
    assert compared >= 4


def test_gaps_of_several_recordings_are_predicted_as_each_by_itself():
    parts = [hidden_objects(following_pairs(pairs=2, moments=50, seed=k), FADING, SENSORS, ONCE) for k in (0, 1)]
    together = HiddenObjects.pooled(parts).predict(FADING, (FOLLOW,))
    apart = [part.predict(FADING, (FOLLOW,)) for part in parts]
    np.testing.assert_allclose(together.position, np.concatenate([each.position for each in apart]), atol=1e-6)
    np.testing.assert_allclose(together.P, np.concatenate([each.P for each in apart]), atol=1e-9)


def test_of_many_gaps_some_are_chosen_the_same_every_time():
    sample = hidden_objects(following_pairs(pairs=3, moments=60), VELOCITY, SENSORS, ONCE)
    few = sample.sampled(5, seed=1)
    assert len(few) == 5
    assert set(few.start.tolist()) <= set(sample.start.tolist())
    np.testing.assert_array_equal(sample.sampled(5, seed=1).start, few.start)
    np.testing.assert_array_equal(sample.sampled(len(sample), seed=1).start, sample.start)


def test_nothing_to_learn_from_and_nonlinear_interactions():
    scene = following_pairs(pairs=1, moments=5)
    assert hidden_objects(scene, VELOCITY, SENSORS) is None
    with pytest.raises(InputError, match="expected ground truth"):
        hidden_objects(dataclasses.replace(scene, ground_truth=None), VELOCITY, SENSORS)
    sample = hidden_objects(following_pairs(pairs=1, moments=40), VELOCITY, SENSORS, ONCE)
    with pytest.raises(InputError, match="linear motions and interactions"):
        sample.predict(VELOCITY, (Repulsion(),))
    with pytest.raises(InputError, match="or mixtures"):
        sample.predict(settings_of(Mixture()), ())

"""Predicting all tracks jointly: as stepping without detections, as the textbook, with edges that go on to act."""

from dataclasses import replace

import numpy as np
import pytest

from saga_fg import ConstantAcceleration, ConstantVelocity, Curvilinear, InputError, Sensor, Tracker, TrackerSettings
from saga_fg.estimators import GraphFilter, JointKalmanFilter
from saga_fg.estimators.reference import Gaussian, kalman_predict
from saga_fg.model.edge_rules import Following
from saga_fg.model.interactions import SharedVelocity
from saga_fg.model.sensor import NoiseModel
from saga_fg.tracking import ClassSettings
from saga_fg.types.boxes import MAX_POSITION
from tests.saga_fg.traffic_frames import columns, frame, run, seen, straight

HORIZONS = [0.5, 1.0, 2.0, 5.0]
LED = Following(interaction=SharedVelocity(along_heading=True), rate=1.0)
CLASSES = {
    "car": ClassSettings(motion=Curvilinear(turn_time=2.0), max_deviation=np.inf),
    "truck": ClassSettings(motion=ConstantAcceleration(0.5, fading_time=3.0), max_deviation=np.inf),
}


def braking(t):
    """A leader that brakes at 3 m/s^2 from 2 s on, a follower, and a car apart."""
    slowed = max(t - 2.0, 0.0)
    return np.array([[12 * t - 1.5 * slowed**2, 0.0], [12 * t - 14.0, 0.0], [5.0, 60.0]])


def followed(estimator="kalman", edges=(LED,), until=3.0, **values):
    """A tracker that has seen the traffic so far, boxes and headings included."""
    settings = TrackerSettings(CLASSES, edges=edges, estimator=estimator, **values)
    tracker = Tracker(settings, {"lidar": Sensor(noise={"default": NoiseModel(position=0.2)})})
    label = ["truck", "car", "car"]
    run(tracker, seen(np.random.default_rng(4), braking, np.arange(0, until, 0.1), label=label, yaw=0.02))
    return tracker


@pytest.mark.parametrize("stationary", [0.0, 0.5])
def test_a_prediction_is_what_frames_without_detections_would_lead_to(stationary):
    tracker = followed(stationary_share=stationary)
    now = tracker.step(frame(3.0, []))
    found = tracker.predict(HORIZONS)
    assert found.timestamp == 3.0
    assert found.times.tolist() == [found.timestamp + h for h in HORIZONS]
    assert (found.id.tolist(), found.label.tolist()) == (now.id.tolist(), now.boxes.label.tolist())
    expected = {h: tracker.step(frame(found.timestamp + h, [])) for h in np.arange(0.5, 5.1, 0.5)}
    for k, h in enumerate(HORIZONS):
        then = expected[h]
        assert found.position[k] == pytest.approx(then.boxes.position[:, :2], abs=1e-9)
        assert found.velocity[k] == pytest.approx(then.boxes.velocity, abs=1e-9)
        assert found.position_covariance[k] == pytest.approx(then.position_covariance, rel=1e-9)
        assert found.velocity_covariance[k] == pytest.approx(then.velocity_covariance, rel=1e-9)


@pytest.mark.parametrize(
    ("name", "kind"), [("kalman", JointKalmanFilter), ("isam2", GraphFilter), ("fixed-lag", GraphFilter)]
)
def test_every_estimator_predicts_as_the_textbook(name, kind, monkeypatch):
    """With the recorded F, b and Q: means to 1e-9 standard deviations, the joint covariance to 1e-9 relative."""
    tracker, transitions = followed(name), []
    estimator, origin = tracker._state.joint.estimator, np.tile(tracker._state.origin, 3)
    x = Gaussian(estimator.joint_mean([1, 2, 3]), estimator.joint_covariance([1, 2, 3]))
    predict = kind.predict

    def recording(self, transition):
        transitions.append(transition)
        predict(self, transition)

    monkeypatch.setattr(kind, "predict", recording)
    found = tracker.predict(HORIZONS, joint=True)
    assert len(transitions) == 10
    places = np.array([0, 1, 6, 7, 12, 13])  # x, y of three states of six components
    for k, transition in enumerate(transitions):
        assert transition.nodes.tolist() == [1, 2, 3]
        x = kalman_predict(x, transition.F_matrix.toarray(), transition.b, transition.Q_matrix.toarray())
        if (k + 1) / 2 in HORIZONS:
            row, P = HORIZONS.index((k + 1) / 2), x.covariance[np.ix_(places, places)]
            apart = found.position[row].ravel() - x.mean[places] - origin
            assert (np.abs(apart) / np.sqrt(np.diag(P))).max() < 1e-9
            assert np.linalg.norm(found.joint_covariance[row] - P) < 1e-9 * np.linalg.norm(P)


@pytest.mark.parametrize("stationary", [0.0, 0.5])
def test_joint_covariances_are_positive_definite_and_hold_those_of_each_track(stationary):
    tracker = followed(stationary_share=stationary)
    assert tracker.predict([1.0]).joint_covariance is None
    found = tracker.predict([0.0, *HORIZONS], joint=True)
    for P, own in zip(found.joint_covariance, found.position_covariance, strict=True):
        assert np.allclose(P, P.T, rtol=1e-12)
        assert np.linalg.eigvalsh(P).min() > 0
        for k in range(len(found)):
            assert P[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] == pytest.approx(own[k])
    together = found.joint_covariance[-1]
    correlation = together[0, 2] / np.sqrt(together[0, 0] * together[2, 2])
    assert correlation > 0.3, "the follower does as its leader does"
    assert np.abs(together[:4, 4:]).max() < 1e-6, "the car apart is independent"


def test_edges_go_on_to_act_a_follower_slows_down_behind_a_braking_leader():
    alone, led = followed(edges=()).predict(HORIZONS), followed().predict(HORIZONS)
    assert alone.velocity[-1, 1, 0] > 10.5
    assert led.velocity[-1, 1, 0] < alone.velocity[-1, 1, 0] - 1.5
    assert led.position[-1, 1, 0] < alone.position[-1, 1, 0] - 5.0
    assert led.position_covariance[-1, 1, 0, 0] < alone.position_covariance[-1, 1, 0, 0]
    assert led.position[:, 2] == pytest.approx(alone.position[:, 2], abs=0.3)


def test_edges_are_those_of_the_graph_on_the_way():
    """A leader that draws away to beyond the reach of the rule acts no longer."""
    parting = straight([(0, 0), (-20, 0)], [(20, 0), (10, 0)])
    positions = []
    for max_gap in (18.0, 60.0):
        rule = replace(LED, max_gap=max_gap, gap_scale=np.inf)
        tracker = Tracker(TrackerSettings({"default": ClassSettings(motion=ConstantVelocity(1.0))}, edges=(rule,)))
        run(tracker, seen(np.random.default_rng(0), parting, np.arange(0, 0.4, 0.1), velocity=parting(1) - parting(0)))
        positions.append(tracker.predict([4.0]).position[0, 1, 0])
    assert positions[0] < positions[1] - 2.0


def test_headings_turn_with_the_velocity():
    def bend(t):
        return 30 * np.array([[np.sin(0.3 * t), 1 - np.cos(0.3 * t)]])

    tracker = Tracker(TrackerSettings({"default": ClassSettings(motion=Curvilinear(turn_time=5.0))}))
    run(tracker, [frame(t, bend(t), yaw=0.3 * t) for t in np.arange(0, 4, 0.1)])
    found = tracker.predict([0.0, 0.4, 1.0])
    assert found.yaw[0, 0] == pytest.approx(0.3 * 3.9, abs=0.05)
    assert (np.diff(found.yaw[:, 0]) > 0.02).all()
    course = np.arctan2(found.velocity[:, 0, 1], found.velocity[:, 0, 0])
    assert np.diff(found.yaw[:, 0]) == pytest.approx(np.diff(course), abs=1e-6)


@pytest.mark.parametrize("estimator", ["kalman", "isam2", "fixed-lag"])
def test_looking_ahead_leaves_no_trace(estimator):
    silent, watched = followed(estimator, until=1.0), followed(estimator, until=1.0)
    for t in np.arange(1.0, 3.0, 0.1):
        seen_now = frame(t, braking(t), label=["truck", "car", "car"])
        watched.predict([0.0, 0.3, 7.0], joint=True)
        watched.tracks(t + 0.7)
        assert columns(watched.step(seen_now)) == columns(silent.step(seen_now))


def test_only_what_is_reported_is_predicted_and_what_can_be():
    settings = TrackerSettings(edges=(), min_hits=2, tentative_score_factor=0.0)
    tracker, far = Tracker(settings), MAX_POSITION - 20.0
    run(tracker, [frame(0.1 * k, [(far + 0.4 * k, 0), (far, 80)], velocity=((4, 0), (0, 0))) for k in range(4)])
    tracker.step(frame(0.4, [(far + 1.6, 0), (far, 80), (far, 40)]))
    assert tracker.predict([0.0]).id.tolist() == [1, 2]
    found = tracker.predict([1.0, 30.0], joint=True)
    assert found.id.tolist() == [2]
    assert found.position.shape == (2, 1, 2)
    assert found.joint_covariance.shape == (2, 2, 2)


def test_without_tracks_there_is_an_empty_answer_and_without_a_frame_none():
    tracker = Tracker()
    with pytest.raises(InputError, match="predict: expected a frame before"):
        tracker.predict([1.0])
    tracker.step(frame(0.0, []))
    found = tracker.predict([1.0, 2.0], joint=True)
    assert len(found) == 0
    assert found.position.shape == (2, 0, 2)
    assert found.joint_covariance.shape == (2, 0, 0)


def test_horizons_that_are_none_are_refused(subtests):
    for horizons in [[], [-1.0], [1.0, np.nan], [np.inf], [2.0, 1.0], [1.0, 1.0], [61.0], 1.0, [[1.0]], ["soon"], None]:
        with subtests.test(horizons=horizons):
            tracker = followed(until=0.5)
            with pytest.raises(InputError, match=r"horizons.*: expected"):
                tracker.predict(horizons)
            with pytest.raises(InputError, match="horizons: expected a list of seconds"):
                tracker.predict(1.0)

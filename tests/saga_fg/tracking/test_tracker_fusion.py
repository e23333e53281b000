"""Several sensors at once: who may start a track, what scores add up to, and sensors that fall silent."""

import numpy as np
import pytest

from saga_fg import Sensor, Tracker, TrackerSettings
from saga_fg.model.sensor import NoiseModel
from tests.saga_fg.traffic_frames import frame, run, seen, straight

WEAK = {"camera": Sensor(initiation="confirmed", noise={"default": NoiseModel(position=0.5)})}
TENTHS = np.arange(0, 2, 0.1)


def independent(**values):
    return TrackerSettings(edges=(), **values)


def test_a_weak_sensor_alone_needs_repeated_evidence():
    tracker = Tracker(independent(), WEAK)
    reported = [len(t) for t in run(tracker, [frame(t, (10.0, 0.0), "camera") for t in TENTHS[:6]])]
    assert reported == [0, 0, 1, 1, 1, 1]


def test_what_waits_for_confirmation_may_be_reported_with_a_share_of_its_score():
    tracker = Tracker(independent(tentative_score_factor=0.25), WEAK)
    scores = [t.score.tolist() for t in run(tracker, [frame(t, (10.0, 0.0), "camera", score=0.8) for t in TENTHS[:3]])]
    assert scores == [[pytest.approx(0.2)], [pytest.approx(0.2)], [pytest.approx(0.8)]]


def test_another_sensor_confirms_it_at_once():
    tracker = Tracker(independent(), WEAK)
    frames = [frame(0.0, (10.0, 0.0), "camera"), frame(0.05, (10.0, 0.0), "lidar"), frame(0.1, (10.0, 0.0), "camera")]
    assert [t.id.tolist() for t in run(tracker, frames)] == [[], [1], [1]]


def test_a_strong_sensor_needs_nobody():
    assert len(Tracker(independent(), WEAK).step(frame(0.0, (10.0, 0.0), "lidar"))) == 1


def test_what_two_sensors_see_scores_higher_than_what_one_of_them_misses():
    both, one = (10.0, 0.0), (10.0, 20.0)
    tracker = Tracker(independent(), {"camera": Sensor()})
    tracks = run(tracker, [frame(0.0, [both, one], "lidar", score=0.6), frame(0.02, both, "camera", score=0.6)])[-1]
    near = np.argsort(tracks.boxes.position[:, 1])
    assert tracks.score[near[0]] > 0.7
    assert tracks.score[near[1]] < 0.5


@pytest.mark.parametrize("method", ["kalman", "fixed-lag"])
def test_tracks_live_on_the_other_sensor_while_one_is_out(method):
    rng = np.random.default_rng(4)
    truth = straight([(5.0, -3.0), (5.0, 3.0)], [(8.0, 0.0), (9.0, 0.5)])
    lidar = [f for f in seen(rng, truth, np.arange(0, 8, 0.1)) if not 2.0 < f.timestamp < 5.0]
    camera = seen(rng, truth, np.arange(0.03, 8, 0.08), noise=0.4, sensor="camera")
    tracker = Tracker(independent(estimator=method), WEAK)
    history = run(tracker, sorted(lidar + camera, key=lambda f: f.timestamp))
    assert all(sorted(t.id.tolist()) == [1, 2] for t in history)
    last = history[-1]
    order = np.argsort(last.id)
    assert last.boxes.position[order, :2] == pytest.approx(truth(last.timestamp), abs=0.4)

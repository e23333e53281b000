"""Several sensors' words about one track: what they add up to, and when they count as a confirmation."""

import numpy as np
import pytest

from saga_fg import Sensor, Tracker, TrackerSettings
from saga_fg.model.sensor import FieldOfView
from saga_fg.tracking import ClassSettings
from saga_fg.tracking.track_table import PRIOR_LOGIT, SensorEvidence
from tests.saga_fg.traffic_frames import frame, run

NONE = np.empty(0, dtype=np.int64)


def logit(p):
    return np.log(p / (1 - p))


def updated(evidence, sensor, now, seen=(), p=(), missed=None, chance=0.8, n=1):
    missed = np.zeros(n, dtype=bool) if missed is None else np.array(missed)
    evidence.update(sensor, now, np.array(seen, dtype=np.int64), np.array(p, dtype=float), missed, np.full(n, chance))


def initiated(p=0.6, sensor="lidar", now=0.0):
    return SensorEvidence.empty().initiated(sensor, np.atleast_1d(p), now)


def test_one_sensor_alone_is_taken_at_its_word():
    evidence = initiated(0.6)
    assert evidence.probability(0.0, 0.2) == pytest.approx([0.6])
    updated(evidence, "lidar", 0.1, [0], [0.3])
    assert evidence.probability(0.1, 0.2) == pytest.approx([0.3])


def test_two_sensors_add_their_log_odds_over_the_prior():
    evidence = initiated(0.6)
    updated(evidence, "camera", 0.05, [0], [0.7])
    assert logit(evidence.probability(0.05, 0.2)) == pytest.approx([logit(0.6) + logit(0.7) - PRIOR_LOGIT])


def test_a_sensor_that_should_have_seen_it_lowers_the_odds():
    evidence = initiated(0.6)
    updated(evidence, "camera", 0.05, missed=[True], chance=0.8)
    assert logit(evidence.probability(0.05, 0.2)) == pytest.approx([logit(0.6) + np.log(0.2)])


def test_a_sensor_that_has_seen_it_before_says_nothing_by_a_miss():
    evidence = initiated(0.6)
    updated(evidence, "camera", 0.05, [0], [0.7])
    before = evidence.probability(0.05, 0.2)
    updated(evidence, "camera", 0.1, missed=[True])
    assert evidence.probability(0.1, 0.2) == pytest.approx(before)


def test_without_a_detection_nothing_is_said():
    evidence = initiated(0.6)
    updated(evidence, "camera", 1.0, missed=[True])
    assert np.isnan(evidence.probability(1.0, 0.2)).all()


def test_words_count_for_a_while_only():
    evidence = initiated(0.9)
    updated(evidence, "camera", 1.0, [0], [0.5])
    assert evidence.probability(1.0, 0.2) == pytest.approx([0.5])


def test_the_order_in_which_sensors_speak_does_not_matter():
    a, b = initiated([0.6, 0.4]), initiated([0.6, 0.4])
    words = [("camera", [0], [0.7], [False, True]), ("radar", [1], [0.8], [True, False])]
    for evidence, order in ((a, words), (b, words[::-1])):
        for sensor, seen, p, missed in order:
            updated(evidence, sensor, 0.1, seen, p, missed, n=2)
    assert a.probability(0.1, 0.2) == pytest.approx(b.probability(0.1, 0.2))


def test_confirmed_by_a_second_sensor_or_by_repetition():
    evidence = initiated([0.6, 0.6, 0.6])
    updated(evidence, "lidar", 0.1, [1], [0.6], n=3)
    updated(evidence, "camera", 0.1, [0], [0.6], n=3)
    assert evidence.confirmed(3).tolist() == [True, False, False]
    updated(evidence, "lidar", 0.2, [1], [0.6], n=3)
    assert evidence.confirmed(3).tolist() == [True, True, False]


def test_tracks_that_end_take_their_evidence_with_them():
    evidence = initiated([0.6, 0.4, 0.2])
    evidence = evidence.select(np.array([False, True, True]))
    new = evidence.initiated("camera", np.array([0.9]), 0.0)
    evidence = evidence.append(new)
    assert evidence.probability(0.0, 0.2) == pytest.approx([0.4, 0.2, 0.9])


def test_the_steadiest_sensor_speaks_for_a_track():
    evidence = initiated([0.6, 0.6])
    for k in range(1, 5):
        updated(evidence, "lidar", k / 10, [0], [0.6], missed=[False, True], n=2)
        updated(evidence, "camera", k / 10, [1], [0.6], missed=[True, False], n=2)
    hits, opportunities = evidence.best_hits()
    assert hits.tolist() == [5, 4]
    assert opportunities.tolist() == [5, 4]


def test_what_others_have_just_seen():
    evidence = initiated([0.6, 0.6], now=0.0)
    updated(evidence, "camera", 1.0, [1], [0.6], n=2)
    assert evidence.detected_by_others("lidar", 1.0, 0.2).tolist() == [False, True]
    assert evidence.detected_by_others("camera", 1.0, 0.2).tolist() == [False, False]


def test_a_sensor_that_falls_silent_keeps_its_field_of_view():
    evidence = initiated([0.6, 0.6])
    assert evidence.look("camera", np.array([True, False])).tolist() == [True, True]
    assert evidence.look("camera", np.array([False, False])).tolist() == [
        True,
        True,
    ]  # of the LiDAR
    assert evidence.look("lidar", np.array([True, False])).tolist() == [True, False]


def test_a_car_behind_outlives_an_outage_of_the_lidar_while_the_camera_looks_ahead():
    ahead = Sensor(field_of_view=FieldOfView(min_azimuth=-0.5, max_azimuth=0.5))
    classes = {"default": ClassSettings(max_deviation=20.0)}
    tracker = Tracker(TrackerSettings(classes, max_out_of_view=0.5), {"camera": ahead})
    pose = {"world_T_ego": np.eye(4)}
    for k in range(5):
        tracker.step(frame(k / 10, [(-20.0, 0.0)], **pose))
    outage = run(tracker, [frame(0.5 + k / 10, [], "camera", **pose) for k in range(20)])
    assert [len(tracks) for tracks in outage] == [1] * 20

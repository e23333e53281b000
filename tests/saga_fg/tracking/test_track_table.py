"""The table of tracks: evidence of sensors, existence, and objects that one detection stands for."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.config import load_config
from saga_fg import Boxes, Detections, Frame, Sensor, Tracker, TrackerSettings
from saga_fg.model.sensor import FieldOfView, NoiseModel
from saga_fg.numerics.arrays import Columns
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.tracking import ClassSettings, ExistenceSettings, track_life
from saga_fg.tracking.track_life import LASTING_SHARE, reported_score
from saga_fg.tracking.track_table import PRIOR_LOGIT, SensorEvidence, TrackTable
from saga_fg.tracking.tracker_state import LIFETIME
from saga_fg.tracking.update import existences
from tests.saga_fg.traffic_frames import NAN, frame, run


def table(*x: float) -> TrackTable:
    """The tracks of a tracker after a frame of cars at these places."""
    tracker = Tracker()
    tracker.step(frame(0.0, [(each, 0.0) for each in x]))
    return tracker.snapshot().table


def arrays(columns: Columns, path: str = "") -> dict[str, np.ndarray]:
    """All columns by their names, those of sub-tables as table.column."""
    found = {}
    for one in fields(columns):  # type: ignore[arg-type]
        value = getattr(columns, one.name)
        if isinstance(value, Columns):
            found |= arrays(value, f"{path}{one.name}.")
        elif isinstance(value, np.ndarray):
            found[path + one.name] = value
    return found


def test_all_columns_are_appended_and_selected_together():
    a, b = table(0.0, 10.0), table(20.0)
    both = a.append(b)
    assert len(both) == 3
    assert {len(column) for column in arrays(both).values()} == {3}
    assert both.sensors.sensors == a.sensors.sensors
    for name, column in arrays(both.select(np.array([False, False, True]))).items():
        np.testing.assert_array_equal(column, arrays(b)[name])


def test_snapshots_share_no_array_that_can_be_written_and_empty_tables_take_tracks():
    tracks = table(0.0, 10.0)
    kept = tracks.copied()
    for name, column in arrays(kept).items():
        np.testing.assert_array_equal(column, arrays(tracks)[name])
        assert not (np.shares_memory(column, arrays(tracks)[name]) and column.flags.writeable)
    tracks = table(0.0, 10.0)
    sensors = tracks.sensors.empty(0, tracks.sensors.sensors)
    empty = TrackTable.empty()
    empty.sensors = sensors
    for name, column in arrays(empty.append(tracks)).items():
        np.testing.assert_array_equal(column, arrays(tracks)[name])


# Several sensors' words about one track: what they add up to, and when they count as a confirmation


def logit(p):
    return np.log(p / (1 - p))


def updated(evidence, sensor, now, seen=(), p=(), missed=None, chance=0.8, n=1):
    missed = np.zeros(n, dtype=bool) if missed is None else np.array(missed)
    evidence.look(sensor, np.ones(n), now)
    evidence.update(sensor, now, np.array(seen, dtype=np.int64), np.array(p, dtype=float), missed, np.full(n, chance))


def initiated(p=0.6, sensor="lidar", now=0.0):
    return SensorEvidence.empty().initiated(sensor, np.atleast_1d(p), now)


def test_log_odds_of_sensors_add_up_over_the_prior():
    evidence = initiated(0.6)
    assert evidence.probability(0.0, 0.2) == pytest.approx([0.6])
    updated(evidence, "lidar", 0.1, [0], [0.3])
    assert evidence.probability(0.1, 0.2) == pytest.approx([0.3])
    evidence = initiated(0.6)
    updated(evidence, "camera", 0.05, [0], [0.7])
    assert logit(evidence.probability(0.05, 0.2)) == pytest.approx([logit(0.6) + logit(0.7) - PRIOR_LOGIT])
    evidence = initiated(0.6)
    updated(evidence, "camera", 0.05, missed=[True], chance=0.8)
    assert logit(evidence.probability(0.05, 0.2)) == pytest.approx([logit(0.6) + np.log(0.2)])


def test_sensors_that_saw_before_or_fall_silent_are_heard_rightly():
    evidence = initiated(0.6)
    updated(evidence, "camera", 0.05, [0], [0.7])
    before = evidence.probability(0.05, 0.2)
    updated(evidence, "camera", 0.1, missed=[True])
    assert evidence.probability(0.1, 0.2) == pytest.approx(before)
    evidence = initiated([0.6, 0.6], now=0.0)
    updated(evidence, "camera", 1.0, [1], [0.6], n=2)
    assert evidence.detected_by_others("lidar", 1.0, 0.2).tolist() == [False, True]
    assert evidence.detected_by_others("camera", 1.0, 0.2).tolist() == [False, False]


def test_words_count_for_a_while_only_and_none_without_a_detection():
    evidence = initiated(0.6)
    updated(evidence, "camera", 1.0, missed=[True])
    assert np.isnan(evidence.probability(1.0, 0.2)).all()
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


def test_a_car_that_is_overtaken_is_reported_out_of_view_if_that_is_wanted():
    ahead = Sensor(field_of_view=FieldOfView(min_azimuth=-0.5, max_azimuth=0.5))
    for wanted in (False, True):
        settings = TrackerSettings({"default": ClassSettings(max_deviation=50.0)}, report_out_of_view=wanted)
        tracker = Tracker(settings, {"camera": ahead})
        for k in range(5):
            tracker.step(frame(k / 10, [(20.0, 0.0)], "camera", world_T_ego=np.eye(4)))
        passed = yaw_transform(40.0, 3.0, 0.0, 0.0)
        behind = run(tracker, [frame(0.5 + k / 10, [], "camera", world_T_ego=passed) for k in range(10)])
        assert [len(tracks) for tracks in behind] == [wanted] * 10


# Existence by Bayes' rule, and what it makes of a track's score

SETTINGS = ExistenceSettings()


def score(probability, hits, opportunities, coasting=False, existence=0.9, settings=SETTINGS, best=0.0):
    """Reported scores of tracks with these attributes."""
    probability = np.atleast_1d(np.asarray(probability, dtype=float))
    n = len(probability)
    sensors = SensorEvidence.empty(n, ["lidar"])
    sensors.hits[:], sensors.opportunities[:], sensors.visibility[:] = hits, opportunities, 1.0
    best = np.maximum(probability, best)
    table = replace(
        TrackTable.empty(), existence=np.full(n, existence), score=probability, best_score=best, sensors=sensors
    )
    return reported_score(table, np.arange(n), np.full(n, coasting), settings)[0]


def after_miss(r, p_detect, elapsed, settings):
    none = np.empty(0, dtype=np.int64), np.empty(0)
    missed, survival = np.ones(len(r), dtype=bool), np.exp(-elapsed / LIFETIME)
    return existences(r, missed, p_detect, *none, survival, settings.neutral_score)


def after_hit(r, probability, settings):
    missed, every = np.zeros(len(r), dtype=bool), np.arange(len(r))
    return existences(r, missed, np.zeros(len(r)), every, probability, 1.0, settings.neutral_score)


def test_a_miss_and_a_hit_are_those_of_bayes():
    r = np.array([0.1, 0.5, 0.9])
    expected = r * 0.1 / (r * 0.1 + (1 - r))
    assert after_miss(r, np.full(3, 0.9), 0.0, SETTINGS) == pytest.approx(expected)
    assert after_miss(r, np.zeros(3), 2.0, SETTINGS) == pytest.approx(r * np.exp(-2.0 / LIFETIME)), "nobody looked"
    r = np.array([0.2, 0.7])
    assert after_hit(r, np.full(2, SETTINGS.neutral_score), SETTINGS) == pytest.approx(r)
    assert (after_hit(r, np.full(2, 0.9), SETTINGS) > r).all()
    assert (after_hit(r, np.full(2, 0.05), SETTINGS) < r).all()


def test_scores_are_those_of_the_detections_and_of_steadiness():
    assert score([0.4, 0.8], 1, 5) == pytest.approx([0.4, 0.8])
    assert score([0.4, 0.8], 1, 5, coasting=True) == pytest.approx([0.36, 0.72])
    weighted = ExistenceSettings(prior_opportunities=1.0, hit_ratio_weight=0.5)
    counts = ((9, 9), (1, 1), (4, 9))
    steady, new, flickering = (score(0.6, *count, settings=weighted).item() for count in counts)
    assert steady == pytest.approx(0.6 * np.sqrt(0.9))
    assert steady > new > flickering
    assert score(0.05, 5, 5, best=0.9) == pytest.approx(LASTING_SHARE * 0.9)
    assert score(0.5, 5, 5, best=0.9) == pytest.approx(0.5), "detections that are not weak are believed"
    assert score(0.05, 5, 5, best=0.9, coasting=True) == pytest.approx(0.9 * LASTING_SHARE * 0.9)


@pytest.mark.parametrize("family", ["kitti", "nuscenes"])
@given(data=st.data())
@settings(max_examples=12, deadline=None)
def test_a_score_is_monotone_in_all_evidence_of_the_track(family, data):
    """A higher probability of any detection lowers no score, then or later."""
    count = 8
    p = data.draw(st.lists(st.floats(0.1, 0.9), min_size=count, max_size=count), "probabilities")
    seen = [True, True, *data.draw(st.lists(st.booleans(), min_size=count - 2, max_size=count - 2), "detected")]
    raised = data.draw(st.sampled_from([k for k in range(count) if seen[k]]), "raised")
    higher = [*p]
    higher[raised] += data.draw(st.floats(0.0, 0.95 - p[raised]), "by")
    low, high = (_scores_of_one_object(family, values, seen) for values in (p, higher))
    assert low.keys() <= high.keys()
    assert all(high[k] >= value - 1e-9 for k, value in low.items())


def _scores_of_one_object(family, probability, seen):
    """Score by frame of a stationary object, detected in some frames with these probabilities."""
    tracker, dt = load_config(family).new_tracker("saga"), 0.5 if family == "nuscenes" else 0.1
    scores = {}
    for k, (p, there) in enumerate(zip(probability, seen, strict=True)):
        value = (np.log(p / (1 - p)) + 2.4) / 0.4 if family == "kitti" else p
        tracks = tracker.step(frame(dt * k, [(0.0, 0.0)] * there, score=value))
        assert len(tracks) <= 1
        if len(tracks):
            scores[k] = float(tracks.score[0])
    return scores


# Second boxes of one object: tracks over others are tentative until they are known to be objects of their own

SIZES = {"motorcycle": (2.1, 0.8, 1.5), "pedestrian": (0.7, 0.7, 1.8)}


def crowd_frame(time, position, score, label="motorcycle", size=None, yaw=0.5 * np.pi):
    """A frame of objects of one class, each with its score."""
    n = len(position)
    centre = np.concatenate([np.asarray(position, dtype=float).reshape(-1, 2), np.ones((n, 1))], axis=1)
    boxes = Boxes.of(
        np.full(n, label), centre, np.tile(SIZES[label] if size is None else size, (n, 1)), np.full(n, yaw)
    )
    return Frame(time, "lidar", Detections(boxes, np.broadcast_to(np.asarray(score, dtype=float), n)))


def unresolved_settings(**values):
    classes = {"default": ClassSettings(nms_distance=0.3, initiation_score=0.03, max_distance=2.0)}
    return TrackerSettings(classes, edges=(), **{"tentative_score_factor": 0.1, **values})


def test_a_second_box_is_tentative_until_seen_twice_beside_the_first():
    tracks = Tracker(unresolved_settings()).step(crowd_frame(0.0, [(0.5, 0.0), (0.0, 0.0)], [0.5, 0.8]))
    assert tracks.score.tolist() == [pytest.approx(0.05), pytest.approx(0.8)]
    tracker = Tracker(unresolved_settings())
    run(tracker, [crowd_frame(0.1 * k, [(0.0, 0.0)], 0.8) for k in range(5)])
    both = [tracker.step(crowd_frame(0.5 + 0.1 * k, [(0.0, 0.0), (0.7, 0.0)], 0.6)) for k in range(4)]
    assert [tracks.score[1] for tracks in both] == [pytest.approx(s) for s in (0.06, 0.06, 0.6, 0.6)]
    tracker = Tracker(unresolved_settings())
    run(tracker, [crowd_frame(0.1 * k, [(0.0, 0.0)], 0.8) for k in range(5)])
    both = [tracker.step(crowd_frame(0.5 + 0.1 * k, [(0.0, 0.0), (0.4, 0.0)], 0.6)) for k in range(6)]
    assert all(tracks.score[1] == pytest.approx(0.06) for tracks in both)


def test_a_second_box_is_matched_to_what_the_others_leave():
    tracker = Tracker(unresolved_settings())
    run(tracker, [crowd_frame(0.1 * k, [(0.0, 0.0)], 0.8) for k in range(10)])
    tracker.step(crowd_frame(1.0, [(0.0, 0.0), (0.5, 0.0)], [0.8, 0.6]))
    tracks = tracker.step(crowd_frame(1.1, [(0.4, 0.0)], 0.7))  # nearer to the second one
    assert tracker.assignment.id.tolist() == [1]
    assert dict(zip(tracks.id.tolist(), tracks.coasting.tolist(), strict=True))[2] == pytest.approx(0.1)


def test_a_miss_counts_against_a_track_where_the_surer_one_is_detected():
    tracker = Tracker(unresolved_settings(existence=ExistenceSettings(delete_below=0.0)))
    run(tracker, [crowd_frame(0.1 * k, [(0.0, 0.0)], 0.8) for k in range(10)])
    tracker.step(crowd_frame(1.0, [(0.0, 0.0), (0.7, 0.0)], 0.6))
    left = []
    for k, seen in enumerate(([(0.0, 0.0)], [(0.0, 0.0)], [(0.0, 0.0)], [], [(0.0, 0.0), (0.7, 0.0)])):
        tracker.step(crowd_frame(1.1 + 0.1 * k, seen, 0.6))
        left.append(tracker._state.table.unresolved.tolist())
    alone, most = track_life.ALONE, track_life.MAX_FRAMES
    expected = [track_life.FRAMES + alone, most, most, most, most - 1]
    assert left == [[0.0, frames] for frames in expected]


def test_rough_positions_or_no_tentative_tracks_change_what_a_second_box_is():
    rough = {"lidar": Sensor(noise={"default": NoiseModel(position=0.7)})}
    tracks = Tracker(unresolved_settings(), rough).step(crowd_frame(0.0, [(0.0, 0.0), (0.5, 0.0)], [0.8, 0.6]))
    assert tracks.score.tolist() == [pytest.approx(0.8), pytest.approx(0.6)]
    tracker = Tracker(unresolved_settings(tentative_score_factor=0.0))
    history = run(tracker, [crowd_frame(0.1 * k, [(0.0, 0.0), (0.4, 0.0)], [0.8, 0.6]) for k in range(5)])
    assert [tracks.id.tolist() for tracks in history] == [[1]] * 5


@pytest.mark.parametrize("unknown", [{"size": (NAN, NAN, NAN)}, {"yaw": NAN}])
def test_boxes_of_unknown_extent_are_objects_of_their_own(unknown):
    tracks = Tracker(unresolved_settings()).step(crowd_frame(0.0, [(0.0, 0.0), (0.5, 0.0)], [0.8, 0.6], **unknown))
    assert tracks.score.tolist() == [pytest.approx(0.8), pytest.approx(0.6)]


@pytest.mark.parametrize("estimator", ["kalman", "isam2", "fixed-lag"])
def test_a_track_is_reported_from_its_nth_hit_on(estimator):
    frames = [crowd_frame(0.1 * k, [(0.0, 0.0)], 0.8) for k in range(4)]
    tracker = Tracker(unresolved_settings(min_hits=3, tentative_score_factor=0.0, estimator=estimator))
    assert [len(tracks) for tracks in run(tracker, frames)] == [0, 0, 1, 1]

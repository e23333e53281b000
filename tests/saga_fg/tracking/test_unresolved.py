"""Second boxes of one object: tracks over others are tentative until they are known to be objects of their own."""

import numpy as np
import pytest

from saga_fg import Boxes, Detections, Frame, Sensor, Tracker, TrackerSettings
from saga_fg.model.sensor import NoiseModel
from saga_fg.tracking import AssociationSettings, ClassSettings, ExistenceSettings, unresolved
from tests.saga_fg.traffic_frames import NAN, run

SIZES = {"motorcycle": (2.1, 0.8, 1.5), "pedestrian": (0.7, 0.7, 1.8)}


def crowd_frame(time, position, score, label="motorcycle", size=None, yaw=0.5 * np.pi):
    """A frame of objects of one class, each with its score."""
    n = len(position)
    centre = np.concatenate([np.asarray(position, dtype=float).reshape(-1, 2), np.ones((n, 1))], axis=1)
    boxes = Boxes.of(
        np.full(n, label), centre, np.tile(SIZES[label] if size is None else size, (n, 1)), np.full(n, yaw)
    )
    return Frame(time, "lidar", Detections(boxes, np.broadcast_to(np.asarray(score, dtype=float), n)))


def settings(**values):
    classes = {"default": ClassSettings(nms_distance=0.3, initiation_score=0.03, max_distance=2.0)}
    return TrackerSettings(classes, edges=(), **{"tentative_score_factor": 0.1, **values})


def doubled(rng, row, time, label, double=0.4, miss=0.1):
    """A frame of a row of parked objects: some are missed, of some there is a second box 0.5 m beside the first."""
    seen = row[rng.random(len(row)) > miss]
    second = seen[rng.random(len(seen)) < double] + [0.5, 0.0]
    position = np.concatenate([seen, second]) + 0.08 * rng.normal(size=(len(seen) + len(second), 2))
    score = np.concatenate([rng.uniform(0.5, 0.8, len(seen)), rng.uniform(0.3, 0.6, len(second))])
    return crowd_frame(time, position, score, label)


def counted_tracks(label, spacing, seed):
    """Mean number of tracks that count, over and above the objects that are detected; of a row of 8 for 15 s."""
    row, rng = np.stack([spacing * np.arange(8), np.zeros(8)], axis=1), np.random.default_rng(seed)
    association = AssociationSettings(clutter_area=3000.0)
    tracker = Tracker(settings(association=association, stationary_share=0.5))
    excess = []
    for k in range(30):
        frame = doubled(rng, row, 0.5 * k, label)
        objects = len(np.unique(np.abs(frame.detections.boxes.position[:, 0, None] - row[:, 0]).argmin(axis=1)))
        tracks = tracker.step(frame)
        excess.append(((tracks.score > 0.2) & (tracks.coasting <= 0)).sum() - objects)
    return np.mean(excess[5:])


@pytest.mark.parametrize(("label", "spacing"), [("motorcycle", 1.2), ("pedestrian", 1.3)])
def test_in_a_crowd_most_second_boxes_make_no_track_that_counts(monkeypatch, label, spacing):
    excess = np.mean([counted_tracks(label, spacing, seed) for seed in range(5)])
    monkeypatch.setattr(unresolved, "OVERLAP", 2.0)
    without = np.mean([counted_tracks(label, spacing, seed) for seed in range(5)])
    assert excess < 0.8 * without, (excess, without)


@pytest.mark.parametrize(("label", "spacing"), [("motorcycle", 0.7), ("pedestrian", 0.6)])
def test_objects_that_stand_close_together_all_count_after_a_while(label, spacing):
    row, rng = np.stack([spacing * np.arange(8), np.zeros(8)], axis=1), np.random.default_rng(0)
    tracker = Tracker(settings())
    for k in range(30):
        tracks = tracker.step(crowd_frame(0.5 * k, row + 0.05 * rng.normal(size=row.shape), 0.7, label))
    assert len(tracks) == 8
    assert (tracks.score > 0.2).sum() >= 7


def test_of_two_boxes_in_the_first_frame_the_surer_one_counts():
    tracks = Tracker(settings()).step(crowd_frame(0.0, [(0.5, 0.0), (0.0, 0.0)], [0.5, 0.8]))
    assert tracks.score.tolist() == [pytest.approx(0.05), pytest.approx(0.8)]


def test_a_box_beside_a_live_track_is_tentative_until_seen_twice_beside_it():
    tracker = Tracker(settings())
    run(tracker, [crowd_frame(0.1 * k, [(0.0, 0.0)], 0.8) for k in range(5)])
    both = [tracker.step(crowd_frame(0.5 + 0.1 * k, [(0.0, 0.0), (0.7, 0.0)], 0.6)) for k in range(4)]
    assert [tracks.score[1] for tracks in both] == [pytest.approx(s) for s in (0.06, 0.06, 0.6, 0.6)]


def test_a_box_that_overlaps_more_than_objects_do_stays_tentative():
    tracker = Tracker(settings())
    run(tracker, [crowd_frame(0.1 * k, [(0.0, 0.0)], 0.8) for k in range(5)])
    both = [tracker.step(crowd_frame(0.5 + 0.1 * k, [(0.0, 0.0), (0.4, 0.0)], 0.6)) for k in range(6)]
    assert all(tracks.score[1] == pytest.approx(0.06) for tracks in both)


def test_an_object_that_walks_away_from_another_counts_from_there_on():
    tracker = Tracker(settings())
    scores = []
    for k in range(8):
        tracks = tracker.step(crowd_frame(0.1 * k, [(0.0, 0.0), (0.35 + 0.08 * k, 0.0)], [0.8, 0.6], "pedestrian"))
        scores.append(tracks.score[1])
    assert scores[0] == pytest.approx(0.06)
    assert scores[-1] == pytest.approx(0.6)


def test_a_second_box_is_matched_to_what_the_others_leave():
    tracker = Tracker(settings())
    run(tracker, [crowd_frame(0.1 * k, [(0.0, 0.0)], 0.8) for k in range(10)])
    tracker.step(crowd_frame(1.0, [(0.0, 0.0), (0.5, 0.0)], [0.8, 0.6]))
    tracks = tracker.step(crowd_frame(1.1, [(0.4, 0.0)], 0.7))  # nearer to the second one
    assert tracker.assignment.id.tolist() == [1]
    assert dict(zip(tracks.id.tolist(), tracks.coasting.tolist(), strict=True))[2] == pytest.approx(0.1)


def test_a_miss_counts_against_a_track_where_the_surer_one_is_detected():
    tracker = Tracker(settings(existence=ExistenceSettings(delete_below=0.0)))
    run(tracker, [crowd_frame(0.1 * k, [(0.0, 0.0)], 0.8) for k in range(10)])
    tracker.step(crowd_frame(1.0, [(0.0, 0.0), (0.7, 0.0)], 0.6))
    left = []
    for k, seen in enumerate(([(0.0, 0.0)], [(0.0, 0.0)], [(0.0, 0.0)], [], [(0.0, 0.0), (0.7, 0.0)])):
        tracker.step(crowd_frame(1.1 + 0.1 * k, seen, 0.6))
        left.append(tracker._state.table.unresolved.tolist())
    alone, most = unresolved.ALONE, unresolved.MAX_FRAMES
    expected = [unresolved.FRAMES + alone, most, most, most, most - 1]
    assert left == [[0.0, frames] for frames in expected]


def test_where_positions_are_rough_overlap_tells_nothing():
    rough = {"lidar": Sensor(noise={"default": NoiseModel(position=0.7)})}
    tracks = Tracker(settings(), rough).step(crowd_frame(0.0, [(0.0, 0.0), (0.5, 0.0)], [0.8, 0.6]))
    assert tracks.score.tolist() == [pytest.approx(0.8), pytest.approx(0.6)]


def test_without_tentative_tracks_a_second_box_is_not_reported():
    tracker = Tracker(settings(tentative_score_factor=0.0))
    history = run(tracker, [crowd_frame(0.1 * k, [(0.0, 0.0), (0.4, 0.0)], [0.8, 0.6]) for k in range(5)])
    assert [tracks.id.tolist() for tracks in history] == [[1]] * 5


@pytest.mark.parametrize("unknown", [{"size": (NAN, NAN, NAN)}, {"yaw": NAN}])
def test_boxes_of_unknown_extent_are_objects_of_their_own(unknown):
    tracks = Tracker(settings()).step(crowd_frame(0.0, [(0.0, 0.0), (0.5, 0.0)], [0.8, 0.6], **unknown))
    assert tracks.score.tolist() == [pytest.approx(0.8), pytest.approx(0.6)]


def test_other_classes_may_overlap():
    boxes = crowd_frame(0.0, [(0.0, 0.0), (0.0, 0.4)], [0.8, 0.6]).detections
    labels = np.array(["motorcycle", "pedestrian"])
    frame = Frame(
        0.0,
        "lidar",
        Detections(
            Boxes(labels, *(getattr(boxes.boxes, n) for n in ("position", "size", "yaw", "velocity"))), boxes.score
        ),
    )
    assert Tracker(settings()).step(frame).score.tolist() == [pytest.approx(0.8), pytest.approx(0.6)]


@pytest.mark.parametrize("estimator", ["kalman", "isam2", "fixed-lag"])
def test_a_track_is_reported_from_its_nth_hit_on(estimator):
    frames = [crowd_frame(0.1 * k, [(0.0, 0.0)], 0.8) for k in range(4)]
    tracker = Tracker(settings(min_hits=3, tentative_score_factor=0.0, estimator=estimator))
    assert [len(tracks) for tracks in run(tracker, frames)] == [0, 0, 1, 1]


def test_a_copy_keeps_what_is_unresolved():
    tracker = Tracker(settings())
    tracker.step(crowd_frame(0.0, [(0.0, 0.0), (0.7, 0.0)], [0.8, 0.6]))
    other = Tracker(settings())
    other.restore(tracker.snapshot())
    for k in (1, 2):
        frame = crowd_frame(0.1 * k, [(0.0, 0.0), (0.7, 0.0)], [0.8, 0.6])
        assert tracker.step(frame).score.tolist() == other.step(frame).score.tolist()

"""The greedy nearest-centre tracker."""

import numpy as np
import pytest

from saga_fg import Detection, Detections, Frame, GreedyTracker, Sensor
from saga_fg.model.sensor import Extrinsics
from saga_fg.tracking import GreedySettings
from tests.saga_fg.traffic_frames import NAN, at_pose, columns, frame, run, seen, straight, turning_vehicle

TRUTH = straight([(0, 0), (20, 5)], [(8, 0), (4, 2)])
TENTHS = np.arange(0, 2, 0.1)


def test_tracks_are_where_the_detections_are():
    frames = seen(np.random.default_rng(0), TRUTH, TENTHS)
    for told, tracks in zip(frames, run(GreedyTracker(), frames), strict=True):
        assert tracks.id.tolist() == [1, 2]
        assert tracks.boxes.position.tolist() == told.detections.boxes.position.tolist()
        assert tracks.score == pytest.approx([0.9, 0.9])
        assert tracks.coasting.tolist() == [0.0, 0.0]


def test_velocities_are_the_detectors_or_differences_not_too_close_in_time():
    tracker = GreedyTracker()
    tracker.step(frame(0.0, [(0, 0)], velocity=(3.0, 1.0)))
    measured = tracker.step(frame(0.5, [(2, 1)], velocity=(5.0, NAN)))
    assert measured.boxes.velocity[0].tolist() == [5.0, 2.0]
    differenced = tracker.step(frame(1.0, [(4, 1)]))
    assert differenced.boxes.velocity[0].tolist() == [4.0, 0.0]
    at_once = tracker.step(frame(1.0, [(4.1, 1)], "camera"))
    assert at_once.boxes.velocity[0].tolist() == [4.0, 0.0]
    assert GreedyTracker().step(frame(0.0, [(0, 0)])).boxes.velocity.tolist() == [[0.0, 0.0]]
    tracker = GreedyTracker()
    run(tracker, [frame(0.0, [(0, 0)]), frame(0.5, [(1, 0)])])
    soon = tracker.step(frame(0.6, [(1.5, 0)]))
    assert soon.boxes.velocity[0, 0] == pytest.approx(2.0)
    assert tracker.step(frame(0.75, [(1.5, 0)])).boxes.velocity[0, 0] == pytest.approx(2.0)


def test_the_strongest_detection_chooses_first():
    tracker = GreedyTracker()
    tracker.step(frame(0.0, [(0, 0)]))
    rows = [Detection("car", (0.1, 0, 0), score=0.5), Detection("car", (1.0, 0, 0), score=0.8)]
    tracks = tracker.step(Frame(0.1, "lidar", Detections.of(rows)))
    assert dict(zip(tracks.boxes.position[:, 0].tolist(), tracks.id.tolist(), strict=True)) == {0.1: 2, 1.0: 1}


def test_each_class_has_a_reach_of_its_own_or_the_default_one():
    tracker = GreedyTracker()
    tracker.step(frame(0.0, [(0, 0), (50, 0)], label=["car", "pedestrian"]))
    tracks = tracker.step(frame(0.1, [(2, 0), (52, 0), (2, 1)], label=["car", "pedestrian", "pedestrian"]))
    assert tracks.id.tolist() == [1, 3, 4]
    for reach, expected in (({"default": 1.0}, 2), ({"car": 1.0}, 1)):
        tracker = GreedyTracker(GreedySettings(max_distance=reach))
        tracker.step(frame(0.0, [(0, 0)], label="tram"))
        assert tracker.step(frame(0.1, [(3, 0)], label="tram")).id.tolist() == [expected]


def test_an_unseen_track_is_projected_and_kept_for_a_while():
    tracker = GreedyTracker(GreedySettings(max_coasting=1.0))
    run(tracker, [frame(0.0, [(0, 0)], velocity=(10.0, 0.0)), frame(0.5, [])])
    assert tracker.step(frame(0.9, [(9, 0)])).id.tolist() == [1]
    run(tracker, [frame(1.5, []), frame(2.0, [])])
    assert tracker.step(frame(2.1, [(9, 0)])).id.tolist() == [2]


def test_scores_may_be_logits_and_frames_late_or_empty():
    tracks = GreedyTracker(sensors={"lidar": Sensor(score="logit")}).step(frame(0.0, [(0, 0)], score=2.0))
    assert tracks.score == pytest.approx([1 / (1 + np.exp(-2.0))])
    assert len(GreedyTracker().tracks(1.0)) == 0
    tracker = GreedyTracker()
    assert len(tracker.step(frame(0.0, []))) == 0
    tracker.step(frame(0.1, [(0, 0)]))
    assert len(tracker.step(frame(0.2, []))) == 0
    assert len(tracker.tracks(0.2)) == 0
    tracker = GreedyTracker()
    tracker.step(frame(1.0, [(0, 0)]))
    tracks = tracker.step(frame(0.8, [(0.1, 0)]))
    assert tracks.timestamp == 1.0
    assert np.isfinite(tracks.boxes.velocity).all()


def test_projected_tracks_leave_no_trace():
    frames = seen(np.random.default_rng(1), TRUTH, TENTHS)
    silent, watched = GreedyTracker(), GreedyTracker()
    for f in frames:
        expected, got = silent.step(f), watched.step(f)
        assert columns(got) == columns(expected)
        ahead = watched.tracks(f.timestamp + 0.5)
        assert ahead.boxes.position[:, :2] == pytest.approx(got.boxes.position[:, :2] + 0.5 * got.boxes.velocity)
        assert ahead.coasting == pytest.approx([0.5, 0.5])


@pytest.mark.parametrize("coordinates", ["ego", "sensor"])
def test_frames_in_vehicle_or_sensor_coordinates_give_the_same_tracks(coordinates):
    mount = Extrinsics(x=1.2, y=0.4, yaw=0.6)
    frames = seen(np.random.default_rng(1), TRUTH, TENTHS, velocity=(4.0, 1.0))
    told = [at_pose(f, turning_vehicle(f.timestamp), coordinates, mount.ego_T_sensor) for f in frames]
    sensors = {"lidar": Sensor(extrinsics=mount)}
    for a, b in zip(
        run(GreedyTracker(sensors=sensors), frames), run(GreedyTracker(sensors=sensors), told), strict=True
    ):
        assert a.id.tolist() == b.id.tolist()
        assert b.boxes.position == pytest.approx(a.boxes.position, abs=1e-9)
        assert b.boxes.velocity == pytest.approx(a.boxes.velocity, abs=1e-9)

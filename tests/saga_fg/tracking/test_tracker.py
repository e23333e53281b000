"""The tracker: one object followed, initiation, coasting and deletion, coordinates, classes."""

import numpy as np
import pytest

from saga_fg import (
    Detection,
    Detections,
    Frame,
    Sensor,
    Tracker,
    TrackerSettings,
)
from saga_fg.model.sensor import Extrinsics, FieldOfView, NoiseModel
from saga_fg.tracking import AssociationSettings, ClassSettings, ExistenceSettings
from tests.saga_fg.traffic_frames import (
    NAN,
    assert_same,
    at_pose,
    columns,
    frame,
    run,
    seen,
    straight,
    turning_vehicle,
)

TENTHS = np.arange(0, 5, 0.1)


def settings(edges=(), **values):
    """Independent objects of one kind of class settings."""
    existence = {k: values.pop(k) for k in ("report_above", "confirm_above", "delete_below") if k in values}
    overall = {k: values.pop(k) for k in ("max_delay", "max_coasting", "report_coasting") if k in values}
    association = AssociationSettings(relink_above=values.pop("relink_above", 0.9))
    classes = {"default": ClassSettings(**values)}
    return TrackerSettings(
        classes, edges=edges, association=association, existence=ExistenceSettings(**existence), **overall
    )


# one object


def test_velocities_are_taken_in_or_unknown_along_the_heading():
    first = Tracker().step(frame(0.0, [(0, 0)], velocity=(7.0, -1.0)))
    assert first.boxes.velocity[0] == pytest.approx([7.0, -1.0])
    ignoring = Tracker(sensors={"lidar": Sensor(use_velocity=False)}).step(frame(0.0, [(0, 0)], velocity=(7.0, -1.0)))
    assert ignoring.boxes.velocity[0].tolist() == [0.0, 0.0]
    known = Tracker().step(frame(0.0, [(0, 0)], yaw=np.pi / 2)).velocity_covariance[0]
    assert known == pytest.approx(np.diag([1.0, 25.0]), abs=1e-12)
    unknown = Tracker().step(frame(0.0, [(0, 0)], yaw=NAN)).velocity_covariance[0]
    assert unknown == pytest.approx(25.0 * np.eye(2))


# initiation, coasting, deletion


def test_detections_that_no_track_explains_begin_tracks_if_they_are_not_weak():
    tracker = Tracker(settings())
    assert tracker.step(frame(0.0, [(0, 0)])).id.tolist() == [1]
    assert tracker.step(frame(0.1, [(0, 0), (30, 0)])).id.tolist() == [1, 2]
    assert tracker.step(frame(0.2, [(30, 0), (60, 5), (0, 0)])).id.tolist() == [1, 2, 3]
    tracker = Tracker(settings(initiation_score=0.5, min_score=0.1))
    assert len(tracker.step(frame(0.0, [(0, 0)], score=0.4))) == 0
    assert len(tracker.step(frame(0.1, [(0, 0)], score=0.6))) == 1
    weak = tracker.step(frame(0.2, [(0.5, 0)], score=0.2))
    assert weak.coasting.tolist() == [0.0]
    assert weak.boxes.position[0, 0] > 0.1
    unusable = tracker.step(frame(0.3, [(0.5, 0)], score=0.05))
    assert unusable.coasting == pytest.approx([0.1])


def test_tracks_coast_die_and_are_found_again_in_time():
    tracker = Tracker(settings(max_coasting=1.0, report_coasting=0.55))
    run(tracker, [frame(t, [(10 * t, 0)]) for t in np.arange(0, 1.05, 0.1)])
    coasting = [tracker.step(frame(1.0 + t, [])) for t in np.arange(0.1, 1.25, 0.1)]
    reported = [len(tracks) for tracks in coasting]
    assert reported == [1] * 5 + [0] * 7
    assert coasting[3].coasting == pytest.approx([0.4])
    assert coasting[3].boxes.position[0, :2] == pytest.approx([14.0, 0.0], abs=0.3)
    assert coasting[3].position_covariance[0, 0, 0] > coasting[0].position_covariance[0, 0, 0]
    assert tracker.step(frame(2.3, [(23, 0)])).id.tolist() == [2], "a dead track came back"
    tracker = Tracker(settings(max_coasting=1.0))
    run(tracker, [frame(t, [(10 * t, 0)]) for t in np.arange(0, 1.05, 0.1)])
    run(tracker, [frame(t, []) for t in np.arange(1.1, 1.75, 0.1)])
    again = tracker.step(frame(1.8, [(18, 0)]))
    assert (again.id.tolist(), again.coasting.tolist()) == ([1], [0.0])


def test_doubtful_tracks_end_by_misses_where_the_sensor_looks_and_not_elsewhere():
    ahead = Sensor(field_of_view=FieldOfView(min_azimuth=-0.5, max_azimuth=0.5))
    pose = {"world_T_ego": np.eye(4)}
    left = []
    for position in ((20.0, 0.0), (-20.0, 0.0)):
        tracker = Tracker(settings(max_deviation=20.0), {"camera": ahead})
        tracker.step(frame(0.0, [position], score=0.3, **pose))
        left.append(len(run(tracker, [frame(t, [], "camera", **pose) for t in (0.1, 0.2, 0.3)])[-1]))
    assert left == [0, 1]


def test_belief_reports_tracks_and_keeps_them_alive():
    for score, alive in ((0.95, 1), (0.3, 0)):
        tracker = Tracker(settings(max_deviation=20.0, confirm_above=0.9))
        tracker.step(frame(0.0, [(0, 0)], score=score))
        assert len(run(tracker, [frame(t, []) for t in np.arange(0.1, 1.0, 0.1)])[-1]) == alive
    tracker = Tracker(settings(report_above=0.7))
    assert len(tracker.step(frame(0.0, [(0, 0)], score=0.5))) == 0
    assert tracker.step(frame(0.1, [(0, 0)], score=0.5)).id.tolist() == [1]


def test_of_duplicates_the_stronger_starts_the_track():
    rows = [Detection("car", (0, 0, 0), score=0.6), Detection("car", (0.3, 0, 0), score=0.8)]
    tracks = Tracker().step(Frame(0.0, "lidar", Detections.of(rows)))
    assert tracks.boxes.position[0, 0] == pytest.approx(0.3)
    assert len(tracks) == 1


# classes and motion models


def test_classes_do_not_mix():
    tracker = Tracker()
    tracker.step(frame(0.0, [(0, 0), (0, 1)], label=["car", "pedestrian"]))
    swapped = tracker.step(frame(0.1, [(0, 0), (0, 1)], label=["pedestrian", "car"]))
    assert swapped.boxes.label.tolist() == ["car", "pedestrian"]
    assert swapped.boxes.position[:, 1].tolist() == pytest.approx([1.0, 0.0], abs=0.5)


def test_unknown_sensors_are_the_default_one_and_unknown_ranges_add_no_noise():
    noisy = {"default": Sensor(noise={"default": NoiseModel(position=2.0)})}
    sonar = Tracker(sensors=noisy).step(frame(0.0, [(0, 0)], "sonar")).position_covariance[0]
    assert sonar == pytest.approx(4.0 * np.eye(2))
    assert Tracker().step(frame(0.0, [(0, 0)], "sonar")).position_covariance[0] == pytest.approx(0.09 * np.eye(2))
    sensor = {"lidar": Sensor(noise={"default": NoiseModel(position=0.3, range_noise=0.01)})}
    anywhere = Tracker(sensors=sensor).step(frame(0.0, [(1e6, 1e6)])).position_covariance[0]
    assert anywhere == pytest.approx(0.09 * np.eye(2))
    posed = Tracker(sensors=sensor).step(frame(0.0, [(100, 0)], world_T_ego=np.eye(4))).position_covariance[0]
    assert posed == pytest.approx(np.diag([0.09 + 1.0, 0.09]))


# coordinates


def traffic(seed=3, **fields):
    truth = straight([(0, 0), (15, 4), (-20, -8)], [(8, 0), (5, 1), (0, 0)])
    return seen(np.random.default_rng(seed), truth, TENTHS, **fields)


@pytest.mark.parametrize("coordinates", ["ego", "sensor"])
def test_frames_in_vehicle_or_sensor_coordinates_give_the_same_tracks(coordinates):
    noise = {"default": NoiseModel(0.3, range_noise=0.01, bearing_noise=0.002)}
    mount = Extrinsics(x=1.2, y=0.4, z=1.7, yaw=0.6)
    sensors = {"lidar": Sensor(noise, extrinsics=mount, field_of_view=FieldOfView(-2.0, 1.0))}
    frames = [
        Frame(f.timestamp, f.sensor, f.detections, turning_vehicle(f.timestamp)) for f in traffic(velocity=(4.0, 1.0))
    ]
    told = [at_pose(f, turning_vehicle(f.timestamp), coordinates, mount.ego_T_sensor) for f in frames]
    assert_same(run(Tracker(sensors=sensors), frames), run(Tracker(sensors=sensors), told), tolerance=1e-7)


@pytest.mark.parametrize("first", ["an object", "nothing"])
def test_far_from_the_origin_nothing_changes(first):
    frames = traffic()
    if first == "nothing":
        frames = [frame(-0.1, []), *frames]
    shift = np.array([1e6, -4e6, 0.0])
    T = np.eye(4)
    T[:3, 3] = shift
    moved = [Frame(f.timestamp, f.sensor, f.detections.transformed(T)) for f in frames]
    assert_same(run(Tracker(), frames), run(Tracker(), moved), 2e-9 * 4e6 / 4, shift=shift)


def test_the_same_frames_in_any_order_of_detections_give_the_same_tracks():
    first, second = run(Tracker(), traffic()), run(Tracker(), traffic())
    assert [columns(t) for t in first] == [columns(t) for t in second]
    frames = traffic()
    reversed_later = [frames[0], *(Frame(f.timestamp, f.sensor, f.detections.select([2, 1, 0])) for f in frames[1:])]
    assert_same(run(Tracker(), frames), run(Tracker(), reversed_later), tolerance=1e-9)


def test_the_tracker_tells_which_detection_went_where():
    def told(timestamp, *rows):
        detections = [Detection("car", (*place, 0.0), score=score) for place, score in rows]
        tracker.step(Frame(timestamp, "lidar", Detections.of(detections)))
        return dict(zip(tracker.assignment.detection.tolist(), tracker.assignment.id.tolist(), strict=True))

    tracker = Tracker(settings(initiation_score=0.5, min_score=0.1))
    initiated = told(0.0, ((0, 0), 0.05), ((9, 0), 0.9), ((0, 9), 0.9))
    assert initiated.keys() == {1, 2}  # the first is too weak for anything
    later = told(0.1, ((0, 9.1), 0.9), ((50, 0), 0.9), ((9.1, 0), 0.9))
    assert (later[0], later[2]) == (initiated[2], initiated[1])
    assert later[1] not in initiated.values()
    assert told(0.2) == {}

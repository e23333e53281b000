"""Nonlinear motion and interactions chosen in the tracker's configuration, with every estimator."""

import pickle

import numpy as np
import pytest

from pipelines.configuration.reading import read_settings
from saga_fg import Detection, Detections, Frame, Tracker, TrackerSettings

SETTINGS = """
estimator: {estimator}
classes:
  car: {{motion: {{kind: {motion}}}, max_deviation: .inf}}
  pedestrian: {{motion: {{kind: constant_velocity, acceleration_noise: 0.3}}, max_deviation: .inf}}
edges: [{edges}]
"""
ESTIMATORS = ("kalman", "isam2", "fixed-lag")


def tracker(estimator, edges="", motion="constant_velocity", more=""):
    text = SETTINGS.format(estimator=estimator, edges=edges, motion=motion) + more
    return Tracker(read_settings(TrackerSettings, text))


def tracked(tracker, label, path, seen, dt=0.1):
    """The last track of an object on a path, hidden after `seen` frames, and where it is."""
    for k in range(len(path)):
        boxes = [Detection(label, (*path[k], 1.0), score=0.9)] if k < seen else []
        tracks = tracker.step(Frame(k * dt, "lidar", Detections.of(boxes)))
    (track,) = tracks
    return track, path[-1]


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("motion", ["coordinated_turn", "mixture"])
def test_a_hidden_car_goes_on_turning(estimator, motion):
    angle = 0.5 * np.arange(55) * 0.1
    path = 20.0 * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    straight, there = tracked(tracker(estimator), "car", path, 40)
    turning, _ = tracked(tracker(estimator, motion=motion), "car", path, 40)
    errors = [np.hypot(*(track.position[:2] - there)) for track in (straight, turning)]
    assert errors[1] < 0.5 * errors[0]
    assert errors[0] > 2.0


@pytest.mark.parametrize("estimator", ["isam2", "fixed-lag"])
def test_nonlinear_motion_is_linearised_again_where_measurements_put_it(estimator):
    angle = 0.8 * np.arange(40) * 0.1
    path = 12.0 * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    for motion, again in (("coordinated_turn", True), ("constant_velocity", False)):
        one, other = (tracked(tracker(n, motion=motion), "car", path, 40)[0].position for n in ("kalman", estimator))
        apart = np.abs(np.subtract(one, other)).max()
        assert apart < 0.1
        assert (apart > 1e-6) == again


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_hidden_pedestrian_does_not_walk_through_a_wall(estimator):
    wall = "road_map: {walls: [{name: house, points: [[-9, 4], [9, 4]]}], deviation: 0.05}\n"
    rule = "{kind: repulsion, sources: [wall]}"
    path = np.stack([0.2 * np.arange(45) * 0.1, 1.2 * np.arange(45) * 0.1], axis=1)
    through, _ = tracked(tracker(estimator, more=wall), "pedestrian", path, 20)
    before, _ = tracked(tracker(estimator, rule, more=wall), "pedestrian", path, 20)
    assert through.position[1] > 4.5
    assert before.position[1] < 4.0


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_hidden_follower_brakes_behind_its_leader(estimator):
    rule = "{kind: following, rate: 1.0, interaction: {kind: smooth_driver}, lateral_scale: 3.0}"
    ends = []
    for edges in ("", rule):
        one = tracker(estimator, edges)
        x, speed = 0.0, 10.0
        for k in range(50):
            speed = max(speed - 0.3, 0.0) if k >= 30 else speed
            x += 0.1 * speed
            seen = [Detection("car", (x, 0.0, 1.0), score=0.9)]
            if k < 30:
                seen.append(Detection("car", (k * 1.0 - 16.0, 0.0, 1.0), score=0.9))
            tracks = one.step(Frame(k / 10, "lidar", Detections.of(seen)))
        leader, follower = sorted(tracks, key=lambda track: -track.position[0])
        ends.append((leader.position[0] - follower.position[0], follower.velocity[0]))
    assert ends[1][0] > ends[0][0] + 1.0
    assert ends[1][1] < ends[0][1] - 1.0


def test_pedestrians_who_walk_into_each_other_step_aside():
    gaps = []
    for edges in ("", "{kind: repulsion}"):
        one = tracker("kalman", edges)
        for k in range(50):
            y = 0.12 * k - 3.0
            seen = [
                Detection("pedestrian", (0.1, y, 1.0), score=0.9),
                Detection("pedestrian", (-0.1, -y, 1.0), score=0.9),
            ]
            tracks = one.step(Frame(k / 10, "lidar", Detections.of(seen if k < 18 else [])))
            if k == 26:
                a, b = (track.position[0] for track in tracks)
                gaps.append(abs(a - b))
    assert gaps[1] > gaps[0] + 0.1


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_modes_know_what_stands_and_do_not_lose_it_when_it_departs(estimator):
    """A car at a light, which drives off after five seconds."""
    errors = []
    for motion in ("constant_velocity", "mixture"):
        rng, one, x, off = np.random.default_rng(1), tracker(estimator, motion=motion), 0.0, []
        for k in range(80):
            speed = 0.0 if k < 50 else min(8.0, 0.3 * (k - 50))
            x += 0.1 * speed
            seen = [Detection("car", (x + 0.2 * rng.normal(), 0.2 * rng.normal(), 1.0), score=0.9)]
            (track,) = one.step(Frame(k / 10, "lidar", Detections.of(seen)))
            off.append(np.hypot(track.velocity[0] - speed, track.velocity[1]))
        errors.append([np.mean(off[20:50]), np.mean(off[60:])])
    assert errors[1][0] < 0.5 * errors[0][0]
    assert errors[1][1] < 1.3 * errors[0][1]


def test_a_tracker_with_nonlinear_edges_is_copied_and_goes_on_alike():
    one = tracker("fixed-lag", "{kind: repulsion}", motion="mixture")
    frames = []
    for k in range(8):
        seen = [Detection("pedestrian", (0.2 * i + 0.01 * k, 0.5, 1.0), score=0.9) for i in range(3)]
        seen.append(Detection("car", (0.8 * k, 9.0, 1.0), score=0.9))
        frames.append(Frame(k / 10, "lidar", Detections.of(seen)))
    for frame in frames[:5]:
        one.step(frame)
    twin = pickle.loads(pickle.dumps(one))
    for frame in frames[5:]:
        np.testing.assert_array_equal(one.step(frame).boxes.position, twin.step(frame).boxes.position)

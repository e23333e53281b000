"""Vehicles drawn to the lanes of a map, in the graph of the vehicle and what moves around it."""

from dataclasses import replace

import numpy as np
import pytest

from saga_fg import Boxes, Detections, Frame
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform, yaw_transform
from saga_fg.slam.joint import (
    JointEstimate,
    JointSettings,
    ObjectStates,
    OdometryIncrements,
    OdometryNoise,
    OnlineEstimator,
    estimate_jointly,
    estimate_online,
    lane_key,
)
from saga_fg.slam.joint.lanes import KnownLane, LaneAssociation, assign_lanes, known_lanes
from saga_fg.types.road_map import Lane, RoadMap
from tests.saga_fg.ego_drive import NOISE, new_tracker

RADIUS = 200.0  # m of the bend
ASIDE = 0.15  # m that the left lane lies to the left of where the map has it
POOR = OdometryNoise(bias=0.02)
SETTINGS = JointSettings(POOR, passes=1)


def on_bend(s: FloatArray, d: FloatArray) -> FloatArray:
    """Places s m along a bend to the left, d m to the left of its middle; and the headings there, (..., 3)."""
    angle = s / RADIUS
    r = RADIUS - d
    return np.stack([r * np.sin(angle), RADIUS - r * np.cos(angle), angle], axis=-1)


def road() -> RoadMap:
    s = np.arange(-20.0, 160.0, 5.0)
    lanes = []
    for name, d in (("left", 1.75 - ASIDE), ("right", -1.75)):
        lanes.append(Lane(name, tuple((float(x), float(y)) for x, y in on_bend(s, np.full(len(s), d))[:, :2])))
    return RoadMap(lanes=tuple(lanes), deviation=0.2)


def traffic(seed: int = 0, n: int = 30, dt: float = 0.2) -> tuple[list[Frame], OdometryIncrements, FloatArray]:
    """Frames of a drive in the right lane among six cars that keep their lanes, odometry that turns, true poses."""
    rng = np.random.default_rng(seed)
    t = dt * np.arange(n)
    poses = np.stack([yaw_transform(x, y, 0.5, yaw) for x, y, yaw in on_bend(10.0 * t, np.full(n, -1.75))])
    start = np.array([-12.0, -2.0, 12.0, 15.0, 24.0, 30.0])
    d = np.where(np.arange(6) % 2, 1.75, -1.75) + rng.normal(0, 0.2, 6)
    frames = []
    for k, (time, pose) in enumerate(zip(t, poses, strict=True)):
        places = on_bend(start + (10.0 + np.arange(6) % 3) * time, d)[:, :2]
        world = np.column_stack([places + NOISE * rng.normal(size=places.shape), np.ones(6)])
        boxes = Boxes.of(["car"] * 6, world).transformed(inverse_transform(pose))
        detections = Detections(boxes, np.full(6, 0.9))
        frames.append(Frame(time, "lidar", detections, np.eye(4), "ego", road_map=None if k else road()))
    exact = OdometryIncrements.of(t, poses)
    turned = exact.a_T_b @ yaw_transform(yaw=0.015 * dt)
    return frames, OdometryIncrements(t, turned), poses


def off(path: FloatArray, poses: FloatArray) -> float:
    return float(np.linalg.norm((path - poses)[:, :2, 3], axis=1).max())


def solved(lanes: bool) -> tuple[JointEstimate, FloatArray, float]:
    frames, odometry, poses = traffic()
    estimate = estimate_jointly(frames, odometry, new_tracker, replace(SETTINGS, lanes=lanes), poses[0])
    return estimate, poses, off(estimate.world_T_ego, poses)


def test_lanes_that_traffic_keeps_hold_the_path() -> None:
    _, _, without = solved(False)
    estimate, _, held = solved(True)
    assert estimate.converged
    assert held < without / 2
    left, right = (float(estimate.solution.values.atVector(lane_key(number))[0]) for number in (0, 1))
    assert abs(left - ASIDE) < 0.2
    assert abs(right) < 0.2
    assert abs(estimate.errors[-1, 1] - 0.015) < 3 * estimate.slow_errors.bias


def test_they_hold_it_frame_by_frame() -> None:
    """In a window, so that vehicles and lanes leave it."""
    frames, odometry, poses = traffic(n=24)
    ends = []
    for lanes in (False, True):
        settings = replace(SETTINGS, lanes=lanes)
        estimator = OnlineEstimator(new_tracker(), 1.5, settings, start=poses[0])
        ends.append(off(estimate_online(frames, odometry, estimator).newest, poses))
    assert ends[1] < ends[0] / 2


def test_a_map_alone_changes_nothing() -> None:
    frames, odometry, poses = traffic(n=8)
    bare = [replace(frame, road_map=None) for frame in frames]
    paths = [
        estimate_jointly(some, odometry, new_tracker, settings, poses[0]).world_T_ego
        for some, settings in ((frames, SETTINGS), (bare, SETTINGS), (bare, replace(SETTINGS, lanes=True)))
    ]
    np.testing.assert_allclose(paths[1], paths[0], atol=1e-9)
    np.testing.assert_allclose(paths[2], paths[0], atol=1e-9)


def test_a_vehicle_keeps_the_lane_that_it_surely_drives_along() -> None:
    lanes = known_lanes([None, RoadMap(lanes=(Lane("a", ((0, 0), (90, 0))), Lane("b", ((90, 3.5), (0, 3.5)))))])
    place = np.array([[10.0, 0.2], [20.0, 3.4], [30.0, 3.4], [40.0, 1.75], [-9.0, 0.0], [50.0, 0.0], [60.0, 0.1]])
    velocity = np.array([[9.0, 0], [9.0, 0], [-9.0, 0], [9.0, 0], [9.0, 0], [9.0, 0], [9.0, 2.0]])
    cars = ObjectStates(np.arange(7), ("car",) * 5 + ("pedestrian", "car"), place, velocity, np.zeros(7))
    stands = np.array([0.0, 0, 0.5, 0, 0, 0, 0])

    def found(sideways: float, seen: FloatArray | None = None) -> dict[int, tuple[int, float]]:
        P = np.diag([1e-8, 1e-8, 1e-8, 1e-8, sideways**2, 1e-8])
        which = np.arange(7) if seen is None else seen
        kept = assign_lanes(4, cars, which, stands, (np.eye(4), P), lanes)
        return {one.name: (one.lane, one.probability) for one in kept}

    sure = found(0.05)
    # not 1: against the traffic of the other lane; 3: between lanes; 4: before its beginning; 5: no vehicle
    assert {name: lane for name, (lane, _) in sure.items()} == {0: 0, 2: 1, 6: 0}
    assert sure[0][1] > 0.9
    assert 0.4 < sure[2][1] <= 0.5  # stands perhaps
    assert sure[6][1] < 0.1  # crosses the lane
    assert found(3.0) == {}  # the pose is not known well enough to tell the lane
    assert set(found(0.05, np.array([2]))) == {2}


def test_a_map_that_every_frame_brings_is_read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[int] = []

    def counted(maps: list[RoadMap | None]) -> list[KnownLane]:
        read.append(len(maps))
        return known_lanes(maps)

    monkeypatch.setattr("saga_fg.slam.joint.lanes.known_lanes", counted)
    lanes, same = LaneAssociation(True, []), road()
    for _ in range(3):
        lanes.add_maps(same)
    assert read == [1]

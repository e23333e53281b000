"""Moving objects leave the map, parked ones stay."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.scans import SMALL, SimulatedScans, StaticWorld, simulate_scan
from data_tools.lidar import constant_velocity
from pipelines.config import load_config
from pipelines.slam.joint import path_tracker
from pipelines.slam.lidar_results import metrics
from pipelines.slam.lidar_slam import LidarSlamResult, LidarSlamSettings, lidar_slam
from pipelines.slam.odometry import KeyframeClouds
from pipelines.slam.scan_content import MovingObjects
from saga_fg import Boxes, Detections, Frame
from saga_fg.numerics.geometry import inverse_transform, transform_points, yaw_transform

START, SPEED = np.array([5.0, 1.5, 0.75]), 7.0  # m, m/s, of a car that drives ahead
SIZE = np.array([4.4, 1.8, 1.5])


def drive_behind_a_car(count: int = 24) -> tuple[SimulatedScans, list[Frame], np.ndarray]:
    """Scans of a street in which a car drives, frames with all cars, and the places of the moving one."""
    scans = SimulatedScans(1, count)
    rng, still = np.random.default_rng(0), scans.world
    parked = still.boxes.select(still.boxes.label == "car")
    places, frames = START + np.outer(scans.timestamps, [SPEED, 0, 0]), []
    for k, (time, pose) in enumerate(zip(scans.timestamps.tolist(), scans.world_T_ego, strict=True)):
        mover = Boxes.of(["car"], places[[k]], SIZE[None], [0.0], [[0.0, 0.0]])
        world = StaticWorld(Boxes.concatenate([still.boxes, mover]), still.poles)
        a = min(k, count - 2)
        motion = constant_velocity(inverse_transform(scans.world_T_ego[a]) @ scans.world_T_ego[a + 1], SMALL.period)
        scans._scans[k] = simulate_scan(world, pose, rng, SMALL, motion)
        cars = Boxes.concatenate([parked, mover])
        near = cars.select(np.linalg.norm(cars.position - pose[:3, 3], axis=1) < 30)
        seen = Boxes.of(near.label.tolist(), near.position, near.size, near.yaw).transformed(inverse_transform(pose))
        frames.append(Frame(time, "lidar", Detections(seen, np.full(len(seen), 3.0)), np.eye(4), "ego"))
    return scans, frames, places


def points_on(result: LidarSlamResult, places: np.ndarray, size: np.ndarray = SIZE) -> int:
    """Number of points of the map in boxes along x, above the ground."""
    cloud = np.concatenate(
        [
            transform_points(T, one.points.astype(float))
            for T, one in zip(result.world_T_submap, result.submaps, strict=True)
        ]
    )
    inside = [(np.abs(cloud - place) < size / 2).all(axis=1) & (cloud[:, 2] > 0.3) for place in places]
    return int(np.any(inside, axis=0).sum())


def test_the_trail_of_a_moving_car_is_not_in_the_map() -> None:
    scans, frames, places = drive_behind_a_car()
    settings = LidarSlamSettings(loop_closures=False, landmarks=False)
    before = lidar_slam(scans, "lidar", settings=settings)
    after = lidar_slam(scans, "lidar", settings=settings, objects=(frames, path_tracker(load_config("kitti"))))
    clouds = [KeyframeClouds(scans, one.drive, settings.odometry, one.moving) for one in (before, after)]
    assert len(clouds[1][-1]) < len(clouds[0][-1]) - 20
    assert metrics(after, scans)["scan_to_map_residual"] < metrics(before, scans)["scan_to_map_residual"]
    assert points_on(before, places[5:]) > 200
    assert points_on(after, places[5:]) < 0.05 * points_on(before, places[5:])
    parked = scans.world.boxes.select(scans.world.boxes.label == "car").position
    near = parked[np.abs(parked[:, 0] - scans.world_T_ego[len(frames) // 2, 0, 3]) < 15]
    assert len(near) >= 3
    kept, there = (points_on(one, near, SIZE + 0.4) for one in (after, before))
    assert kept > 0.9 * there > 100


@pytest.mark.parametrize(("turned", "said"), [(0.0, 0), (2.0, 1)])
def test_detections_in_another_frame_are_noticed(turned: float, said: int, caplog: pytest.LogCaptureFixture) -> None:
    scans, frames, _ = drive_behind_a_car(12)
    objects = MovingObjects(path_tracker(load_config("kitti")))
    for k, frame in enumerate(frames):
        boxes = frame.detections.boxes.transformed(yaw_transform(3.0 * turned, yaw=turned))
        objects.check(scans[k], Detections(boxes, frame.detections.score))
    assert (
        caplog.text.count("detections: expected boxes in the frame of the vehicle, at the times of the scans") == said
    )


def test_an_object_moves_when_its_speed_is_sure(subtests: pytest.Subtests) -> None:
    """Speeds above the limit, but by no more than the detections can tell."""
    for speeds, moving in [([4.0] * 2, 0), ([4.0] * 4, 1), ([1.2] * 12, 0)]:
        with subtests.test(speeds=speeds, moving=moving):
            objects, x = MovingObjects(path_tracker(load_config("kitti"))), 10.0
            for k, speed in enumerate(speeds):
                x += 0.1 * speed
                seen = Boxes.of(["car"], [[x, 0.0, 0.75]], SIZE[None], [0.0])
                found = objects.boxes(0.1 * k, Detections(seen, np.array([3.0])), np.eye(4))
            assert len(found) == moving

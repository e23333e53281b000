"""LiDAR SLAM with objects: parked and moving cars in one graph with walls and poles."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from benchmarks.scans import GivenPoses, SimulatedScans
from data_tools.sensor_logs import SensorLog
from data_tools.trajectories import Trajectory, trajectory_errors
from pipelines.config import load_config
from pipelines.slam.lidar_slam import LidarSlamSettings, lidar_slam, with_objects
from pipelines.slam.results import write_lidar_slam
from saga_fg import Boxes, Detections, Frame, InputError
from saga_fg.numerics import inverse_transform, yaw_transform
from saga_fg.slam.sensors import SensorName, SensorSettings
from tests.pipelines.command import done

MOVER = np.array([8.0, -1.5]), np.array([7.0, 0.0])  # m, m/s


def poor_drive(count: int = 24) -> tuple[SimulatedScans, np.ndarray, list[Frame]]:
    """Scans, poor poses of an odometry, and detections of the parked cars and of one that moves."""
    scans = SimulatedScans(1, count)
    truth, rng = scans.world_T_ego.copy(), np.random.default_rng(0)
    parked = scans.world.boxes.select(scans.world.boxes.label == "car").position
    frames = []
    for time, pose in zip(scans.timestamps.tolist(), truth, strict=True):
        moving = np.append(MOVER[0] + MOVER[1] * time, 0.75)
        places = np.concatenate([parked, moving[None]])
        places = places[np.linalg.norm(places - pose[:3, 3], axis=1) < 30]
        places = places + rng.normal(0, 0.05, places.shape)
        boxes = Boxes.of(["car"] * len(places), places).transformed(inverse_transform(pose))
        frames.append(Frame(time, "lidar", Detections(boxes, np.full(len(boxes), 3.0)), np.eye(4), "ego"))
    poor = [truth[0]]
    for a, b in pairwise(truth):
        poor.append(
            poor[-1] @ inverse_transform(a) @ b @ yaw_transform(*rng.normal(0, 0.05, 2), yaw=rng.normal(0, 0.003))
        )
    return scans, np.array(poor), frames


def test_parked_cars_are_landmarks_and_moving_ones_are_tracked(tmp_path: Path) -> None:
    scans, poor, frames = poor_drive()
    settings = LidarSlamSettings(landmarks=False, loop_closures=False)
    alone = lidar_slam(scans, odometry=GivenPoses(poor, 0.003, 0.05), settings=settings)
    found = with_objects(alone, scans, frames, load_config("kitti"), settings)
    reference = Trajectory(scans.timestamps, scans.world_T_ego)
    before = trajectory_errors(alone.trajectory, reference, "start").ate
    assert trajectory_errors(found.trajectory, reference, "start").ate < 0.6 * before
    assert np.trace(found.covariances[-1]) < 0.5 * np.trace(alone.covariances[-1])
    last = found.objects.objects[-1]
    off = np.linalg.norm(last.position - (MOVER[0] + MOVER[1] * scans.timestamps[-1]), axis=1)
    assert off.min() < 0.5
    np.testing.assert_allclose(last.velocity[off.argmin()], MOVER[1], atol=1.5)
    figures = write_lidar_slam(tmp_path / "run", found, scans)
    assert figures["objects"] == len({name for objects in found.objects.objects for name in objects.id.tolist()})
    rows = (tmp_path / "run" / "tracks.csv").read_text().splitlines()[1:]
    assert len(rows) == sum(len(objects.id) for objects in found.objects.objects)
    assert {row.split(",")[2] for row in rows} == {"car"}


def test_landmarks_and_objects_are_in_one_graph() -> None:
    scans, poor, frames = poor_drive(12)
    settings = LidarSlamSettings()
    alone = lidar_slam(scans, odometry=GivenPoses(poor, 0.003, 0.05), settings=settings)
    found = with_objects(alone, scans, frames, load_config("kitti"), settings)
    assert [mark.number for mark in found.landmarks] == [mark.number for mark in alone.landmarks]
    for with_, without in zip(found.landmarks, alone.landmarks, strict=True):
        assert np.trace(with_.covariance) < 1.05 * np.trace(without.covariance)
        assert np.linalg.norm(with_.kind.variable.local(with_.state, without.state)) < 0.5


def test_the_sensors_of_the_vehicle_are_in_the_same_graph() -> None:
    """Fixes place a vehicle of poor odometry, also where the graph has room for objects."""
    scans, poor, frames = poor_drive()
    truth = scans.world_T_ego
    frames = [replace(frame, detections=Detections.empty()) for frame in frames]
    rng, times = np.random.default_rng(1), scans.timestamps
    speed = np.gradient(truth[:, 0, 3], times)
    rest = np.zeros_like(speed)
    tables: dict[SensorName, np.ndarray] = {
        "gps": np.column_stack([times, truth[:, :3, 3] + rng.normal(0, 0.02, (len(times), 3))]),
        "wheels": np.column_stack([times, speed]),
        "imu": np.column_stack([times, np.gradient(speed, times), rest, rest + 9.81, rest, rest, rest]),
    }
    gps = replace(SensorSettings().gps, deviation=0.02, height_deviation=0.02)
    settings = LidarSlamSettings(landmarks=False, loop_closures=False)
    log, config = SensorLog(tables, SensorSettings(gps=gps)), load_config("kitti")
    alone = lidar_slam(scans, odometry=GivenPoses(poor, 0.003, 0.05), settings=settings, log=log)
    without, found = (with_objects(alone, scans, frames, config, settings, log=one) for one in (None, log))

    def error(path: Trajectory) -> float:
        return float(np.linalg.norm(path.positions - truth[:, :3, 3], axis=1).mean())

    assert error(found.trajectory) < 1.1 * error(alone.trajectory)
    assert error(found.trajectory) < 0.6 * error(without.trajectory)


def test_a_scan_without_a_frame_is_named() -> None:
    scans, poor, frames = poor_drive(6)
    with pytest.raises(InputError, match=r"expected one of detections at 0\.500 s, the time of a scan"):
        with_objects(
            lidar_slam(scans, odometry=GivenPoses(poor, 0.003, 0.05)), scans, frames[:-1], load_config("kitti")
        )


def test_the_command_with_objects(recordings: Path, tmp_path: Path) -> None:
    arguments = [str(recordings / "kitti"), "--objects", "--scans", "8", "--output", str(tmp_path / "run")]
    outcome = done("slam", "scans", *arguments)
    assert "trajectory against the recording: ATE" in outcome.stdout
    assert "without objects against the recording: ATE" in outcome.stdout
    figures = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert figures["objects"] > 0
    assert {"map", "map.ply"} <= {file.name for file in (tmp_path / "run").iterdir()}
    assert (tmp_path / "run" / "tracks.csv").read_text().count("\n") > 10

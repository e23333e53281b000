"""LiDAR SLAM: landmarks where they stand, loops closed, and every file of a run."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from benchmarks.scans import GivenPoses, SimulatedScans, drive
from data_tools.lidar import Scan, Submap, read_scan
from data_tools.pose_graphs import read_g2o
from data_tools.trajectories import Trajectory, read_kitti_poses, read_tum_poses, trajectory_errors
from pipelines.slam.drive import placed_clouds
from pipelines.slam.driver import SlamResult
from pipelines.slam.lidar_slam import POLE, LidarSlam, LidarSlamSettings, lidar_slam
from pipelines.slam.loop_closures import LoopSettings, PlaceLoops
from pipelines.slam.results import covered_spans, write_graph, write_lidar_slam
from saga_fg import InputError
from saga_fg.numerics import inverse_transform, yaw_transform
from saga_fg.slam.submaps import LoopClosure, SubmapSettings


@pytest.fixture(scope="module")
def scans() -> SimulatedScans:
    return SimulatedScans(0, 24)


@pytest.fixture(scope="module")
def result(scans: SimulatedScans) -> SlamResult:
    return lidar_slam(scans)


def test_the_drive_is_found_and_the_covariance_grows(scans: SimulatedScans, result: SlamResult) -> None:
    truth = Trajectory(scans.timestamps, scans.world_T_ego)
    assert trajectory_errors(result.trajectory, truth, "start").relative_translation < 0.05
    assert trajectory_errors(result.online, truth, "start").relative_translation < 0.1
    spread = np.trace(result.covariances[:, 3:, 3:], axis1=1, axis2=2)
    assert spread[0] < spread[len(spread) // 2] < spread[-1]
    assert np.linalg.eigvalsh(result.covariances).min() > 0


def test_landmarks_stand_where_they_do(scans: SimulatedScans, result: SlamResult) -> None:
    poles = [mark for mark in result.landmarks if mark.kind == POLE]
    walls = [mark for mark in result.landmarks if mark.kind.name == "wall"]
    assert len(poles) >= 2
    assert len(walls) >= 4
    squares = []
    for mark in poles:
        off = scans.world.poles[:, :2] - mark.state
        nearest = off[np.argmin(np.linalg.norm(off, axis=1))]
        assert np.linalg.norm(nearest) < 0.2
        squares.append(float(nearest @ np.linalg.solve(mark.covariance, nearest)))
    assert np.mean(squares) < 3 * 2  # of two degrees of freedom
    for mark in walls:
        assert abs(mark.state.planeCoefficients()[2]) < 0.02


def test_a_poor_odometry_is_made_better_by_landmarks() -> None:
    """The recording's poses with a wrong scale and noise stand for a poor odometry; landmarks pull them straight."""
    scans = SimulatedScans(1, 40)
    truth = Trajectory(scans.timestamps, scans.world_T_ego)
    rng = np.random.default_rng(0)
    poor = [scans.world_T_ego[0]]
    for a, b in zip(scans.world_T_ego[:-1], scans.world_T_ego[1:], strict=True):
        noise = yaw_transform(*rng.normal(0, 0.05, 2), yaw=rng.normal(0, 0.003))
        poor.append(poor[-1] @ inverse_transform(a) @ b @ noise)
    found = lidar_slam(scans, odometry=GivenPoses(np.array(poor), 0.003, 0.05))
    before = trajectory_errors(found.odometry, truth, "start").ate
    assert trajectory_errors(found.trajectory, truth, "start").ate < 0.7 * before


def there_and_back() -> tuple[SimulatedScans, np.ndarray]:
    """Scans whose recorded poses drift aside, and the true poses."""
    there = drive(36, speed=8.0)
    poses = np.concatenate([there, there[-2::-1]])
    scans = SimulatedScans(0, world_T_lidar=poses)
    scans.world_T_ego = np.array([yaw_transform(y=0.02 * k) for k in range(len(poses))]) @ poses
    return scans, poses


def test_a_place_that_is_come_back_to_closes_a_loop() -> None:
    scans, poses = there_and_back()
    truth = Trajectory(scans.timestamps, poses)
    settings = LidarSlamSettings(submaps=SubmapSettings(length=8.0), loops=LoopSettings(min_path=10.0), landmarks=False)
    found = lidar_slam(scans, odometry=GivenPoses(scans.world_T_ego, 2e-4, 0.005), settings=settings)
    assert found.loops
    for loop in found.loops:
        first, second = (poses[found.keyframes[k]] for k in (loop.first, loop.second))
        true = inverse_transform(first) @ second
        assert np.linalg.norm((inverse_transform(true) @ loop.first_T_second)[:3, 3]) < 0.6  # scans are skewed here
    before = trajectory_errors(found.odometry, truth, "start").ate
    assert trajectory_errors(found.trajectory, truth, "start").ate < 0.4 * before


class WithFalseLoop:
    """Loops by place, and one that is false."""

    def __init__(self) -> None:
        self.search = PlaceLoops(LoopSettings(min_path=10.0))
        self.false = LoopClosure(1, 5, yaw_transform(6.0, 5.0), 1e-4 * np.eye(6), confirmed=True)

    def add(self, submap: Submap, world_T_submap: np.ndarray) -> list[LoopClosure]:
        false = [self.false] if len(world_T_submap) == 6 else []
        return [*self.search.add(submap, world_T_submap), *false]


def test_loops_and_inflation_go_through_the_files(tmp_path: Path) -> None:
    """Odometry drifts more than it says; a false loop is not in the graph that is written."""
    scans, _ = there_and_back()
    settings = LidarSlamSettings(submaps=SubmapSettings(length=8.0))
    odometry = GivenPoses(scans.world_T_ego, 1e-3, 5e-3)
    slam = LidarSlam(scans.world_T_ego[0], settings, loops=WithFalseLoop(), odometry=odometry)
    for k, time in enumerate(scans.timestamps.tolist()):
        slam.step(scans[k], time)
    found = slam.finish()
    assert len(found.false_loops) == 1
    assert found.selection.inflation.max() > 1.5
    write_graph(tmp_path, found)
    saved = read_g2o(tmp_path / "graph.g2o")
    assert len(saved.first) == len(found.keyframes) - 1 + len(found.loops)
    assert found.loops
    stated = np.linalg.inv([found.drive.moved(*ends)[1] for ends in pairwise(found.drive.keyframes)])
    assert np.linalg.det(saved.information[0]) < 0.1 * np.linalg.det(stated[0])  # odometry as the loops have it


def test_step_by_step_is_what_the_recording_gives(scans: SimulatedScans, result: SlamResult) -> None:
    slam = LidarSlam(scans.world_T_ego[0])
    steps = [slam.step(scans[k], time) for k, time in enumerate(scans.timestamps.tolist())]
    np.testing.assert_allclose([step.world_T_lidar for step in steps], result.online.world_T_ego)
    assert [step.keyframe for step in steps if step.keyframe is not None] == list(range(len(result.keyframes)))
    np.testing.assert_allclose(slam.finish().trajectory.world_T_ego, result.trajectory.world_T_ego)
    truth = scans.world_T_ego
    for step, pose in zip(steps[1:], truth[1:], strict=True):
        assert np.linalg.eigvalsh(step.covariance).min() > 0
        assert np.linalg.norm(step.world_T_lidar[:3, 3] - pose[:3, 3]) < 0.5


def test_what_cannot_be_placed_is_said() -> None:
    scans = SimulatedScans(0, 4)
    slam, nothing = LidarSlam(scans.world_T_ego[0]), Scan.of(np.empty((0, 3)))
    with pytest.raises(InputError, match=r"expected points to begin with, got none"):
        slam.step(nothing, 0.0)
    with pytest.raises(InputError, match=r"expected at least one scan before the end"):
        slam.finish()
    slam.step(scans[0], 0.0)
    with pytest.raises(InputError, match=r"time: expected one after 0\.000000 s, got 0\.000000 s"):
        slam.step(scans[1], 0.0)


def test_every_file_is_written_and_read_back(scans: SimulatedScans, result: SlamResult, tmp_path: Path) -> None:
    figures = write_lidar_slam(tmp_path / "run", result, scans, LidarSlamSettings(map_spacing=0.6))
    folder = tmp_path / "run"
    for trajectory in (
        read_kitti_poses(folder / "trajectory.txt", folder / "times.txt"),
        read_tum_poses(folder / "trajectory.tum"),
    ):
        np.testing.assert_allclose(trajectory.world_T_ego, result.trajectory.world_T_ego, atol=1e-6)
        np.testing.assert_allclose(trajectory.timestamps, scans.timestamps)
    points = read_scan(folder / "map.ply").points
    clouds = [submap.points for submap in result.submaps]
    wide, narrow = (len(placed_clouds(clouds, result.world_T_submap, spacing)) for spacing in (0.6, 0.25))
    assert 1000 < len(points) == wide < narrow
    landmarks = json.loads((folder / "landmarks.json").read_text())
    assert {mark["kind"] for mark in landmarks} == {"pole", "wall"}
    assert all(mark["observations"] >= 4 and np.isfinite([mark["x"], mark["y"]]).all() for mark in landmarks)
    covariances = np.loadtxt(folder / "covariances.csv", delimiter=",", skiprows=1)
    assert covariances.shape == (len(result.keyframes), 22)
    assert json.loads((folder / "metrics.json").read_text()) == figures
    assert (folder / "above.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(tmp_path.iterdir()) == [folder]


def test_a_wall_is_drawn_where_it_was_seen() -> None:
    """On both sides of a street, not across it; what was seen piece by piece is one."""
    assert covered_spans([(8.0, 12.0), (-9.0, -6.0), (13.0, 14.0), (9.0, 10.0)]) == [(-9.0, -6.0), (8.0, 14.0)]

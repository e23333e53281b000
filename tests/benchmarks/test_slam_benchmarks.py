"""Benchmarks of SLAM."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from benchmarks import joint as module
from benchmarks.course import SimulatedCourse
from benchmarks.joint import batch_run, degraded_drive, degraded_odometry, joint_rows, online_run, street
from benchmarks.scans import (
    SENSOR_HEIGHT,
    ScannerSettings,
    SimulatedScans,
    StaticWorld,
    drive,
    ranges,
    scans,
    simulate_scan,
)
from benchmarks.scans import street as world_of
from benchmarks.slam import odometry_rows, scan_to_map_residual
from data_tools.datasets.kitti import kitti_scans
from data_tools.lidar import deskewed
from data_tools.simulator import simulate_scene
from data_tools.trajectories import Trajectory, trajectory_errors
from pipelines.config import load_config
from saga_fg import InputError
from saga_fg.numerics.geometry import transform_points, yaw_of, yaw_transform
from saga_fg.slam.joint import JointSettings, OdometryIncrements, OdometryNoise
from saga_fg.types.boxes import Boxes


def test_courses_that_cannot_be_driven_are_refused(refused, subtests):
    for arguments, message in [
        ("--courses a", "--courses: expected numbers >= 0 with commas, got 'a'"),
        ("--courses 0 --drift -1", "--drift: expected numbers >= 0 with commas"),
    ]:
        with subtests.test(message):
            assert message in refused(f"loops {arguments}")


# `python -m benchmarks joint`: joint against decoupled estimation, in batch and online

SHORT = street(duration=2.0)
CONFIG = load_config("simulated")


def test_recordings_are_pooled_and_the_same_odometry_is_compared():
    scenes = [simulate_scene(SHORT, seed, f"street {seed}") for seed in (1, 2)]
    settings = JointSettings(passes=1)
    rows = list(joint_rows(scenes, [0], partial(batch_run, config=CONFIG, settings=settings)))
    paths = [row for title, row in rows if "path, m" in row]
    assert [row["recording"] for row in paths] == ["street 1", "street 2"]
    for scene, row in zip(scenes, paths, strict=True):
        _, truth, odometry = degraded_drive(scene, settings, "lidar", 0)
        alone = Trajectory(truth.timestamps, odometry.path(truth.world_T_ego[0]))
        assert row["ATE, m: decoupled"] == trajectory_errors(alone, truth).ate
        assert np.isfinite(row["joint"])
    change = next(row["change"] for _, row in rows if row.get("error") == "joint against decoupled")
    squares = np.square([(row["joint"], row["ATE, m: decoupled"]) for row in paths]).sum(axis=0)
    assert change.estimate == pytest.approx(np.sqrt(squares[0] / squares[1]) - 1)


def test_online_objects_are_scored_where_both_report_them():
    scenes = [simulate_scene(replace(SHORT, duration=3.0), seed, f"street {seed}") for seed in (1, 2)]
    rows = list(joint_rows(scenes, [0], partial(online_run, config=CONFIG, settings=JointSettings())))
    paths = [row for title, row in rows if title == "error of the vehicle's path"]
    assert all(0 < row["ATE, m: joint"] < 10 and row["share aside"] == 0 for row in paths)
    objects = [row for title, row in rows if title.startswith("RMSE")]
    assert {row["method"] for row in objects} == {"decoupled", "joint"}
    for row in objects:
        assert row["pairs"] > 5
        assert 0 < row["world velocity, m/s"] < 5
        assert 0 < row["ego position, m"] < 1
    squares = {
        name: sum(row["pairs"] * row["world position, m"] ** 2 for row in objects if row["method"] == name)
        for name in ("decoupled", "joint")
    }
    change = next(row for _, row in rows if row.get("objects") == "moving")
    expected = np.sqrt(squares["joint"] / squares["decoupled"]) - 1
    assert change["world position, m"].estimate == pytest.approx(expected)
    with pytest.raises(InputError, match="expected ground truth"):
        online_run(replace(scenes[0], ground_truth=None), 0, CONFIG, JointSettings())


# Odometry made worse has the errors its model speaks of

STRAIGHT = OdometryIncrements.of(0.5 * np.arange(41.0), np.stack([yaw_transform(2.0 * k) for k in range(41)]))


def test_errors_have_the_deviations_of_the_model():
    noise = OdometryNoise(scale_drift=1e-9, bias_drift=1e-9, course_drift=1e-9)
    drawn = [degraded_odometry(STRAIGHT, noise, np.random.default_rng(seed)) for seed in range(400)]
    ends = np.stack([one.path()[-1] for one in drawn])
    distance, time = 80.0, 20.0
    expected = np.hypot(
        noise.scale * distance, np.sqrt(noise.distance_noise**2 * distance + noise.time_noise**2 * time)
    )
    assert np.std([np.linalg.norm(one.a_T_b[:, :3, 3], axis=1).sum() for one in drawn]) == pytest.approx(
        expected, rel=0.15
    )
    first = np.stack([one.a_T_b[0, :2, 3] for one in drawn])
    expected = np.hypot(noise.course, noise.distance_noise / np.sqrt(2.0))
    assert np.std(np.arctan2(first[:, 1], first[:, 0])) == pytest.approx(expected, rel=0.15)
    expected = np.hypot(noise.bias * time, noise.turn_noise * np.sqrt(time))
    assert np.std(yaw_of(ends[:, :3, :3])) == pytest.approx(expected, rel=0.15)


def test_options_go_together_and_one_thing_is_asked_for_at_a_time(refused):
    assert "expected both --dataroot and --detections" in refused("joint --dataroot somewhere")
    assert "expected one of --dataroot and --dense" in refused("slam --dataroot somewhere --dense 3")


def test_the_command_prints_the_changes(bench, monkeypatch):
    monkeypatch.setattr(module, "street", lambda: SHORT)
    compared = {row.get("compared") for row in bench("joint --scenes 2")}
    assert {"joint against decoupled", "joint against held"} <= compared


# The simulated LiDAR: ranges as geometry says, noise as asked for, skew that de-skew takes away

WORLD = StaticWorld(
    Boxes.of(["car"], [(10.0, 0.0, 1.0)], [(4.0, 2.0, 2.0)], [np.pi / 2], [(0.0, 0.0)]),
    np.array([[0.0, 5.0, 0.5, 3.0]]),
)


def test_ranges_are_those_of_geometry():
    for direction, expected in [
        ((1.0, 0.0, 0.0), 9.0),  # the car, turned: its side is 1 m before its centre
        ((0.0, 1.0, 0.0), 4.5),  # the pole
        ((0.0, 0.0, -1.0), 1.5),  # the ground
        ((0.0, 0.6, 0.8), np.inf),  # over the pole
        ((-1.0, 0.0, 0.0), np.inf),
    ]:
        ((distance,),) = ranges(WORLD, np.array([[0.0, 0.0, 1.5]]), np.array([[direction]]))
        assert distance == pytest.approx(expected)


def test_deskewed_points_lie_where_things_are():
    velocity = np.array([0.0, 0.0, 0.5, 10.0, 0.0, 0.0])
    pose = yaw_transform(1.0, -1.0, 1.5, 0.2)
    scan = simulate_scan(WORLD, pose, np.random.default_rng(0), ScannerSettings(noise=1e-4), velocity)
    points = transform_points(pose, deskewed(scan, velocity).points)
    at_pole = points[(np.hypot(points[:, 0], points[:, 1] - 5) < 1) & (points[:, 2] > 0.2)]
    assert len(at_pole) > 50
    np.testing.assert_allclose(np.hypot(at_pole[:, 0], at_pole[:, 1] - 5), 0.5, atol=2e-3)


# The simulated course: a closed drive that comes back to three stretches, and repeats with its seed


def test_a_lap_closes_scans_repeat_and_cars_leave_and_come():
    course = SimulatedCourse(3, length=5000.0)
    assert len(course) > 6000
    one, other = (course.world_T_ego[np.searchsorted(course.distance, lap * course.lap + 30.0)] for lap in (0, 1))
    np.testing.assert_allclose(one, other, atol=1.0)
    np.testing.assert_array_equal(course[40].points, SimulatedCourse(3, length=200.0)[40].points)
    assert course[40].points[:, 2].min() == pytest.approx(-SENSOR_HEIGHT, abs=0.15)
    assert len(course[-1]) > 5000
    town = SimulatedCourse(0, length=10.0).town
    before, after = (len(town.at(time).boxes) for time in (0.0, 2.0))
    assert before < len(town.world.boxes)
    assert after < len(town.world.boxes)


# `python -m benchmarks slam`: odometry beside KISS-ICP, cost of scans all in


def test_both_are_measured_on_the_same_scans():
    pytest.importorskip("kiss_icp", reason="kiss-icp comes with the extra bench")
    rows = [row for _, row in odometry_rows(SimulatedScans(2, 20))]
    assert [(row["scans"], row["method"]) for row in rows] == [
        (case, name) for case in ("as recorded", "de-skewed") for name in ("saga-fg", "kiss-icp")
    ]
    for row in rows:
        assert np.isfinite(row["RPE, m per 10 m"])
        assert 0 < row["residual, mm"] < 100
        assert row["ms a scan"] > 0
    assert rows[2]["RPE, m per 10 m"] < 0.05


def test_the_command_on_recorded_scans(bench, recordings):
    kitti = recordings / "kitti"
    assert len(kitti_scans(kitti, "0000")) == 90
    rows = bench("slam --scans 20 --no-kiss", "--dataroot", str(kitti))
    assert [row["scans"] for row in rows if row.get("method") == "saga-fg"] == ["as recorded", "de-skewed"]
    assert any(row["table"] == "SLAM all in, CPU time" for row in rows)


def test_wrong_poses_make_a_duller_map():
    poses = drive(12, speed=4.0)
    clouds = [scan.points for scan in scans(world_of(1), poses, skewed=False)]
    wrong = poses @ np.array([yaw_transform(z=0.05 * (-1) ** k) for k in range(len(poses))])
    assert scan_to_map_residual(clouds, poses) < 0.7 * scan_to_map_residual(clouds, wrong)
    assert np.isnan(scan_to_map_residual(clouds[:1], poses[:1]))
    moved = yaw_transform(100.0, 50.0, 3.0, 1.0) @ poses
    assert scan_to_map_residual(clouds, moved) == pytest.approx(scan_to_map_residual(clouds, poses), rel=0.1)

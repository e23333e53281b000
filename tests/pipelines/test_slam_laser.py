"""SLAM with a planar laser: a simulated drive whose odometry does not close."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.scans import LaserKind, laser_drive
from data_tools.laser import LaserLog
from data_tools.trajectories import read_tum_poses
from pipelines.slam.laser_slam import LaserSettings, LaserSlam, laser_slam
from saga_fg import InputError
from saga_fg.numerics import transform, transforms, vectors
from tests.data_tools.carmen_example import write_carmen
from tests.pipelines.command import done


def test_loops_are_closed_and_the_path_is_right(tmp_path: Path) -> None:
    log, true = laser_drive(0, rounds=1.3)
    write_carmen(tmp_path / "drive.log", log)
    output = tmp_path / "out"
    result = done("slam", "laser", tmp_path / "drive.log", "--output", output)
    assert "times real time" in result.stdout
    figures = json.loads((output / "figures.json").read_text())
    assert figures["loops"] >= 10
    assert figures["entropy"] < figures["entropy_scan_matching"]
    assert (output / "map.png").read_bytes().startswith(b"\x89PNG")
    paths = {name: read_tum_poses(output / f"{name}.tum") for name in ("trajectory", "matched", "odometry")}
    off = {name: np.linalg.norm(path.positions[:, :2] - true[:, :2, 2], axis=1) for name, path in paths.items()}
    assert off["trajectory"].max() < 0.3
    assert off["odometry"].max() > 2.0
    again = np.linalg.norm(np.diff(paths["trajectory"].positions[:, :2], axis=0), axis=1)
    np.testing.assert_allclose(again, 0.15, atol=0.05)  # no jumps where corrections begin


def test_times_that_run_backwards_are_named_and_sorted_in_the_result(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    log, _ = laser_drive(1, rounds=0.1)
    log.time[[10, 11]] = log.time[[11, 10]]
    log.time[20] = log.time[19]
    write_carmen(tmp_path / "drive.log", log)
    output = tmp_path / "out"
    done("slam", "laser", tmp_path / "drive.log", "--output", output)
    assert "scan 12: its time is 0.2 s before that of the scan ahead of it; so for 1 of" in caplog.text
    assert "scan 21: its time is that of the scan ahead of it; so for 1 of" in caplog.text
    assert json.loads((output / "figures.json").read_text())["scale_of_the_wheels"] == pytest.approx(1.0, abs=0.05)
    path = read_tum_poses(output / "trajectory.tum")
    assert len(path) == len(log) - 1
    np.testing.assert_allclose(path.timestamps, np.unique(log.time), atol=1e-6)


def test_scans_that_hit_nothing_go_by_the_wheels() -> None:
    log, true = laser_drive(2, rounds=0.12)
    ranges = log.ranges.copy()
    ranges[30:40] = np.nan
    path = laser_slam(LaserLog(log.time, ranges, log.angles, log.odometry, log.robot_T_laser), LaserSettings())
    assert np.linalg.norm(path.poses[:, :2, 2] - true[:, :2, 2], axis=1).max() < 0.15


def test_the_path_starts_at_the_wheels_until_a_scan_hits_something() -> None:
    log, true = laser_drive(2, rounds=0.1)
    log.ranges[:8] = np.nan
    path = laser_slam(log)
    assert path.keyframes[:2].tolist() == [0, 8]
    assert np.linalg.norm(path.poses[:, :2, 2] - true[:, :2, 2], axis=1).max() < 0.16  # by the wheels alone 0.27


def test_scans_that_never_hit_are_one_error() -> None:
    log, _ = laser_drive(2, rounds=0.02)
    with pytest.raises(InputError, match=r"20 readings within largest_range, 0\.1 m, there is none among"):
        laser_slam(log, LaserSettings(largest_range=0.1))
    with pytest.raises(InputError, match="none among 0"):
        LaserSlam().finish()


def test_a_robot_that_stands_still_has_a_map(tmp_path: Path) -> None:
    log, _ = laser_drive(2, rounds=0.1)
    write_carmen(tmp_path / "drive.log", log)
    arguments = ["slam", "laser", str(tmp_path / "drive.log"), "--output", str(tmp_path / "out"), "--scans", "2"]
    result = done(*arguments)
    assert "2 scans, 1 keyframe, 0 loops" in result.stdout


def test_jumps_of_the_wheels_are_counted_and_not_believed(caplog: pytest.LogCaptureFixture) -> None:
    log, true = laser_drive(2, rounds=0.12)
    log.odometry[20:, 0] += 100.0
    path = laser_slam(log)
    assert path.jumps == 1
    assert "scan 21: the wheels moved 100 m in 0.2 s" in caplog.text
    assert np.linalg.norm(path.poses[:, :2, 2] - true[:, :2, 2], axis=1).max() < 0.2


def test_a_log_without_odometry_is_refused_by_name() -> None:
    log, _ = laser_drive(2, rounds=0.1)
    log.odometry[:] = log.odometry[0]
    with pytest.raises(
        InputError, match=r"scan \d+: \d+ % of the readings differ .* the wheels stand still throughout"
    ):
        laser_slam(log)


def test_where_the_laser_is_mounted_does_not_matter() -> None:
    log, true = laser_drive(2, rounds=0.12)
    mounted = np.array([0.25, -0.1, 0.4])
    robot = vectors(transforms(log.odometry) @ np.linalg.inv(transform(mounted)))  # simulated poses are the laser's
    path = laser_slam(replace(log, odometry=robot, robot_T_laser=mounted))
    laser = path.poses @ transform(mounted)
    off = (np.linalg.inv(laser[0]) @ laser)[:, :2, 2] - true[:, :2, 2]
    assert np.linalg.norm(off, axis=1).max() < 0.15


def test_a_gap_in_the_log_is_driven_by_the_wheels() -> None:
    log, true = laser_drive(2, rounds=0.15)
    kept = np.r_[0:40, 60 : len(log)]  # 3 m, 4 s
    path = laser_slam(replace(log, time=log.time[kept], ranges=log.ranges[kept], odometry=log.odometry[kept]))
    assert np.linalg.norm(path.poses[:, :2, 2] - true[kept, :2, 2], axis=1).max() < 0.15


@pytest.mark.parametrize(
    ("kind", "near", "far"),
    [
        (LaserKind(readings=181, reach=8.0, step=0.3), 0.02, 0.03),
        (LaserKind(step=0.5, wheels=1.05), 0.02, 0.03),
        (LaserKind(people=3, step=0.3), 0.1, 0.1),
    ],
    ids=["short range", "fast, wheels", "people"],
)
def test_other_lasers_and_robots(kind: LaserKind, near: float, far: float) -> None:
    """Mean errors, m, of relative poses some scans apart, and between the first and the second pass."""
    log, true = laser_drive(3, rounds=1.3, kind=kind)
    path = laser_slam(log, LaserSettings())
    apart, once = round(3.0 / kind.step), round(len(log) / 1.3)
    for gap, bound in ((apart, near), (once, far)):
        first, second = path.poses[:-gap], path.poses[gap:]
        off = np.linalg.inv(np.linalg.inv(true[:-gap]) @ true[gap:]) @ np.linalg.inv(first) @ second
        assert np.linalg.norm(off[:, :2, 2], axis=1).mean() < bound
    assert path.loops >= 2
    assert path.rejected <= 3


def test_a_bad_step_is_refused(subtests: pytest.Subtests) -> None:
    for points, odometry, message in [
        (np.zeros((5, 3)), np.zeros(3), "points: expected shape"),
        (np.full((5, 2), np.nan), np.zeros(3), r"points.*: expected a finite number"),
        (np.zeros((5, 2)), np.zeros(2), "odometry: expected shape"),
        (np.zeros((5, 2)), np.array([0.0, np.nan, 0.0]), r"odometry.*: expected a finite number"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            LaserSlam().step(points, odometry)

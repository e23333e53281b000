"""`saga-fg slam scans` and `slam laser` on recordings of one's own: folders, bags, their sensors, and what is wrong."""

from __future__ import annotations

import json
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from benchmarks.scans import SimulatedScans, laser_drive
from data_tools.datasets.kitti.dataset import EARTH_RADIUS
from data_tools.recordings import open_recording
from data_tools.trajectories import Trajectory, read_tum_poses, trajectory_errors
from pipelines.slam.laser_slam import laser_slam
from pipelines.slam.lidar_slam import LidarSlamSettings
from saga_fg import InputError
from saga_fg.numerics import inverse_transform, yaw_transform
from tests.data_tools import mcap_example as example
from tests.data_tools.recordings.test_bags import laser_messages
from tests.data_tools.scans_example import BEGIN, FIX, IMU, fix_message, imu_message, scan_messages, write_scans
from tests.pipelines.command import done, refused

needs_ros = pytest.mark.skipif(find_spec("rosbags") is None or find_spec("mcap_ros2") is None, reason="needs rosbags")
COUNT = 24
MOUNT = yaw_transform(1.0, 0.0, 0.5, 0.2)
PLAIN = LidarSlamSettings(landmarks=False, loop_closures=False)


@pytest.fixture(scope="module")
def drive() -> SimulatedScans:
    return SimulatedScans(0, COUNT)


def run(*arguments: object) -> str:
    return " ".join(done("slam", *arguments).output.split())


def error(*arguments: object) -> str:
    return " ".join(refused("slam", *arguments).split())


def times(drive: SimulatedScans) -> np.ndarray:
    return BEGIN + drive.timestamps


def test_a_folder_of_scans(tmp_path: Path, drive: SimulatedScans) -> None:
    scans = [drive[k] for k in range(COUNT)]
    folder = write_scans(tmp_path / "scans", "pcd", scans, times(drive))
    output = run("scans", folder, "--output", tmp_path / "run")
    assert f"{COUNT} scans" in output
    assert "against the recording" not in output
    written = {path.name for path in (tmp_path / "run").iterdir()}
    assert {"trajectory.tum", "trajectory.txt", "map.ply", "graph.g2o", "metrics.json", "above.png"} <= written
    assert "reference.tum" not in written
    path = read_tum_poses(tmp_path / "run" / "trajectory.tum")
    truth = Trajectory(times(drive), drive.world_T_ego)
    assert trajectory_errors(path, truth, "start").ate < 0.1
    output = run("scans", folder, "--map", tmp_path / "run", "--guess", "0,0,0,0", "--output", tmp_path / "again")
    assert not (tmp_path / "again" / "reference.tum").exists()


def bag_messages(drive: SimulatedScans, tilt: float = 0.0) -> list[tuple]:
    """Scans of a LiDAR ahead on the vehicle, inertial samples, and fixes of a drive that begins to the north-east."""
    world_T_start = yaw_transform(0.0, 0.0, 0.0, 0.7)
    poses = world_T_start @ inverse_transform(drive.world_T_ego[0] @ inverse_transform(MOUNT)) @ drive.world_T_ego
    ego = poses @ inverse_transform(MOUNT)
    messages = scan_messages([drive[k] for k in range(COUNT)], times(drive), MOUNT)
    gravity = 9.81 * np.array([0.0, np.sin(tilt), np.cos(tilt)])
    for time in np.arange(BEGIN - 0.05, times(drive)[-1] + 0.05, 0.01):
        messages.append(("/imu", IMU, imu_message(time, gravity, (0, 0, 0)), round(time * 1e9)))
    scale = EARTH_RADIUS * np.cos(np.radians(49.0))
    for time, pose in zip(times(drive), ego, strict=True):
        degrees = np.degrees(pose[:2, 3] / scale) * [1.0, np.cos(np.radians(49.0))]
        messages.append(("/fix", FIX, fix_message(time, 49.0 + degrees[1], 8.4 + degrees[0], 110.0), round(time * 1e9)))
    return sorted(messages, key=lambda message: message[3])


@needs_ros
def test_a_bag_with_inertial_samples_and_fixes(tmp_path: Path, drive: SimulatedScans) -> None:
    bag = example.write_bag(tmp_path / "bag", bag_messages(drive))
    options = ["--no-landmarks", "--sensors", "imu,gps", "--output", tmp_path / "run"]
    run("scans", bag, *options)
    poses = read_tum_poses(tmp_path / "run" / "trajectory.tum").world_T_ego
    step = poses[10, :3, 3] - poses[0, :3, 3]
    truth = drive.world_T_ego @ inverse_transform(MOUNT)
    true = yaw_transform(yaw=0.7)[:3, :3] @ (inverse_transform(truth[0]) @ truth[10])[:3, 3]
    assert np.linalg.norm(step - true) < 0.3  # in the world of the fixes


@needs_ros
def test_a_wrong_mounting_of_an_imu_is_named(
    tmp_path: Path, drive: SimulatedScans, caplog: pytest.LogCaptureFixture
) -> None:
    messages = bag_messages(drive, tilt=1.5)
    run(
        *("scans", example.write_bag(tmp_path / "bag", messages), "--scans", "6", "--no-landmarks"),
        *("--sensors", "imu", "--output", tmp_path / "run"),
    )
    assert "imu: gravity is 86 deg off the vehicle's vertical" in caplog.text


def test_a_lidar_that_is_mounted_elsewhere_is_named(
    tmp_path: Path, drive: SimulatedScans, caplog: pytest.LogCaptureFixture
) -> None:
    folder = write_scans(tmp_path / "scans", "npz", [drive[k] for k in range(COUNT)], times(drive))
    for turn, named in (("0", False), ("1.57", True), ("3.14", False)):
        caplog.clear()
        options = ["--no-landmarks", "--mount", f"0,0,0,0,0,{turn}", "--output", tmp_path / "run"]
        run("scans", folder, *options)
        assert ("check where the LiDAR is mounted" in caplog.text) == named
        misfits = json.loads((tmp_path / "run" / "metrics.json").read_text())["misfits"]
        assert ("lidar" in misfits) == named


def test_options_that_are_wrong_are_named(tmp_path: Path, drive: SimulatedScans) -> None:
    folder = write_scans(tmp_path / "scans", "bin", [drive[0], drive[1]], times(drive)[:2])
    for options, said in (
        (["--mount", "1,2"], "--mount: expected x,y,z,roll,pitch,yaw, m and rad, got '1,2'"),
        (["--topic", "a=b", "--topic", "a=c"], "--topic a=c: expected TOPIC or SENSOR=TOPIC, once for each sensor"),
        (["--layout", "kitty"], "unknown layout 'kitty'"),
        (["--objects"], "--objects: expected a recording with detections"),
    ):
        assert said in error("scans", folder, *options, "--output", tmp_path / "run")
        assert not (tmp_path / "run").exists()


def test_results_are_not_written_among_the_scans(
    tmp_path: Path, drive: SimulatedScans, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_scans(tmp_path / "scans", "bin", [drive[0], drive[1]], times(drive)[:2])
    monkeypatch.chdir(folder)
    for source, output in ((folder, folder), (folder, tmp_path), (".", "."), (".", tmp_path), (".", "../scans")):
        said = error("scans", source, "--output", output)
        assert f"--output {output}: expected another folder than SOURCE and the one that it is in" in said
    assert sorted(path.suffix for path in tmp_path.rglob("*")) == ["", ".bin", ".bin"]


def test_scans_that_cannot_be_placed_are_named(
    tmp_path: Path, drive: SimulatedScans, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "scans"
    folder.mkdir()
    for k in range(3):
        np.save(folder / f"{k}.npy", drive[0].points * (0.01 if k == 0 else 1.0))
    assert "0.npy: scan at 0.000 s: expected points in metres" in error("scans", folder, "--output", tmp_path / "run")
    np.save(folder / "0.npy", drive[0].points)
    for k in (1, 2):
        (folder / f"{k}.npy").write_bytes(b"")
    output = run("scans", folder, "--no-landmarks", "--output", tmp_path / "run")
    assert "scan at 0.100 s: " in caplog.text
    assert "3 scans" in output
    assert "nan" not in output


def test_a_drive_whose_heading_fixes_cannot_tell_is_refused(drive: SimulatedScans, tmp_path: Path) -> None:
    folder = write_scans(tmp_path / "scans", "npz", [drive[k] for k in range(4)], times(drive)[:4])
    table = tmp_path / "gps.csv"
    table.write_text("time [s],x [m],y [m],z [m]\n" + "".join(f"{time},0,0,0\n" for time in times(drive)[:4]))
    said = error("scans", folder, "--sensor-log", f"gps={table}", "--output", tmp_path / "run")
    assert "gps: expected 4 fixes over 5 m of the drive, which tell its heading, got 4 over 2.5 m" in said


@needs_ros
def test_a_laser_in_a_bag(tmp_path: Path) -> None:
    log, _ = laser_drive(0, rounds=0.1)
    run("laser", example.write_bag(tmp_path / "bag", laser_messages(log)), "--output", tmp_path / "run")
    path = read_tum_poses(tmp_path / "run" / "trajectory.tum")
    same = laser_slam(log).poses
    np.testing.assert_allclose(path.world_T_ego[:, :2, 3], same[:, :2, 2], atol=2e-3)
    with pytest.raises(InputError):
        open_recording(tmp_path / "bag")

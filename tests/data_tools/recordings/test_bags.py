"""Scans, lasers and sensors in recordings of ROS 2, written by mcap-ros2-support and by rosbags, and what is wrong."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.scans import SimulatedScans, laser_drive
from data_tools.lidar import Scan
from data_tools.recordings import RecordingOptions, open_recording, read_bag_laser
from data_tools.recordings.bags import cloud_columns
from saga_fg.errors import InputError
from saga_fg.numerics.geometry import transforms, yaw_transform
from tests.data_tools import mcap_example as example
from tests.data_tools.scans_example import (
    BEGIN,
    FIX,
    IMU,
    LASER,
    cloud_message,
    fix_message,
    imu_message,
    laser_message,
    odometry_message,
    scan_messages,
    static_transform,
)

pytest.importorskip("mcap_ros2")
pytest.importorskip("rosbags")

MOUNT = yaw_transform(1.2, 0.0, 1.8, 0.3)
COUNT = 6
TIMES = BEGIN + 0.1 * np.arange(COUNT)


@pytest.fixture(scope="module")
def drive() -> SimulatedScans:
    return SimulatedScans(0, COUNT)


@pytest.fixture(scope="module")
def scans(drive: SimulatedScans) -> list[Scan]:
    return [drive[k] for k in range(COUNT)]


def made(folder: Path) -> Path:
    folder.mkdir()
    return folder


def written(folder: Path, form: str, messages: list[tuple]) -> Path:
    if form == "mcap":
        return example.write_mcap(folder / "drive.mcap", messages)
    return example.write_bag(folder / "bag", messages, "mcap" if form == "bag of mcap" else "sqlite3")


@pytest.mark.parametrize(("form", "absolute"), [("mcap", False), ("bag", True), ("bag of mcap", False)])
def test_scans_are_those_that_were_written(tmp_path: Path, scans: list[Scan], form: str, absolute: bool) -> None:
    messages = scan_messages(scans, TIMES, MOUNT, absolute=absolute, big_endian=absolute)
    found = open_recording(written(tmp_path, form, messages))
    assert found.layout == "bag"
    np.testing.assert_allclose(found.timestamps, TIMES, atol=1e-6)
    np.testing.assert_allclose(found.ego_T_lidar, MOUNT, atol=1e-9)
    assert found.world_T_ego is None
    for row in (0, 1, 5, 2, 3, 0):  # in any order
        np.testing.assert_allclose(found[row].points, scans[row].points, atol=1e-5)
        np.testing.assert_allclose(found[row].time, scans[row].time, atol=1e-6)


def test_more_scans_than_are_read_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("data_tools.recordings.bags._AT_ONCE", 2)
    scans = [Scan(np.full((5, 3), 1.0 + k), np.zeros(5)) for k in range(7)]
    messages = scan_messages(scans, BEGIN + np.arange(7.0))
    for k in (3, 4, 5):  # logged together
        messages[k] = (*messages[k][:3], messages[3][3])
    found = open_recording(example.write_bag(tmp_path / "bag", messages))
    assert [found[k].points[0, 0] for k in (0, 1, 2, 3, 4, 5, 6, 4, 0)] == [1, 2, 3, 4, 5, 6, 7, 5, 1]


def test_the_vehicle_s_sensors_and_poses_come_along(tmp_path: Path, drive: SimulatedScans, scans: list[Scan]) -> None:
    messages = scan_messages(scans, TIMES, MOUNT)
    on_vehicle = yaw_transform(0.5, 0.1, 0.2, np.pi / 2)
    messages.append(("/tf_static", example.TF, static_transform("base_link", "imu", on_vehicle), round(BEGIN * 1e9)))
    for k, time in enumerate(np.arange(BEGIN - 0.1, TIMES[-1] + 0.1, 0.02)):
        logged = round((time + 0.003) * 1e9)
        messages.append(("/imu", IMU, imu_message(time, (0, 0, 9.81), (0, 0, 0.1), "imu"), logged))
        pose = yaw_transform(0.16 * k, 0.0, 0.0, 0.01 * k)
        messages.append(("/odom", example.ODOMETRY, odometry_message(time, pose, 8.0), logged))
        if k % 10 == 0:
            messages.append(("/fix", FIX, fix_message(time, 49.0, 8.4 + 1e-6 * k, 110.0), logged))
    found = open_recording(written(tmp_path, "bag", sorted(messages, key=lambda message: message[3])))
    np.testing.assert_allclose(found.world_T_ego[:, 0, 3], 0.16 * (5 + 5 * np.arange(COUNT)), atol=1e-4)
    tables = found.sensors()
    assert set(tables) == {"imu", "gps", "wheels"}
    np.testing.assert_allclose(tables["imu"][0, 1:], [0, 0, 9.81, 0, 0, 0.1])
    np.testing.assert_allclose(tables["wheels"][:, 1], 8.0)
    np.testing.assert_allclose(tables["gps"][1, 1:], [0.73, 0, 0], atol=0.01)  # m east of the first
    np.testing.assert_allclose(found.mounts["imu"], on_vehicle, atol=1e-9)


def test_poses_beside_a_bag_are_those_of_hilti(tmp_path: Path, scans: list[Scan]) -> None:
    """The bag itself is found where other text lies beside it."""
    bag = example.write_bag(made(tmp_path / "exp") / "bag", scan_messages(scans, TIMES, MOUNT))
    poses = "".join(f"{time:.6f} {k} 0 0 0 0 0 1\n" for k, time in enumerate(TIMES))
    for folder in (bag, bag.parent):
        (folder / "notes.txt").write_text("sunny\n")
        assert folder == bag.parent or open_recording(folder).layout == "bag"
        (folder / "truth.txt").write_text(f"# time x y z qx qy qz qw\n{poses}")
        found = open_recording(folder)
        assert found.layout == "hilti"
        np.testing.assert_allclose(found.world_T_ego[:, 0, 3], np.arange(COUNT))
        (folder / "truth.txt").unlink()


def test_two_clocks_become_one(tmp_path: Path, scans: list[Scan], caplog: pytest.LogCaptureFixture) -> None:
    """The LiDAR counts from its start, the computer knows the time."""
    boot = 50.0 + 0.1 * np.arange(COUNT)
    messages = scan_messages(scans, boot, MOUNT, log_offset=BEGIN - 50.0)
    for time in np.arange(BEGIN, BEGIN + 0.5, 0.02):
        messages.append(("/imu", IMU, imu_message(time, (0, 0, 9.81), (0, 0, 0)), round((time + 0.02) * 1e9)))
    found = open_recording(written(tmp_path, "bag", messages))
    assert "two clocks" in caplog.text
    assert "/imu by -1699999949.980 s" in caplog.text
    np.testing.assert_allclose(found.timestamps, boot)
    np.testing.assert_allclose(found.sensors()["imu"][0, 0], 50.0, atol=0.05)


def test_what_is_wrong_in_a_recording_is_one_line(
    tmp_path: Path,
    scans: list[Scan],
    subtests: pytest.Subtests,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with subtests.test("missing transforms"):
        path = example.write_mcap(tmp_path / "a.mcap", scan_messages(scans, TIMES))
        np.testing.assert_array_equal(open_recording(path).ego_T_lidar, np.eye(4))
        assert "a.mcap: no transforms (/tf, /tf_static) between base_link and lidar: the LiDAR is taken" in caplog.text
    with subtests.test("several topics"):
        twice = [*scan_messages(scans, TIMES), *(("/rear", *m[1:]) for m in scan_messages(scans[:2], TIMES[:2]))]
        path = example.write_mcap(tmp_path / "d.mcap", twice)
        with pytest.raises(InputError, match=r"d\.mcap: expected --topic lidar=TOPIC with one of /points \(6\), /rear"):
            open_recording(path)
        assert len(open_recording(path, RecordingOptions(topics={"lidar": "/rear"}))) == 2
        with pytest.raises(InputError, match=r"--topic lidar=/front: unknown topic of sensor_msgs/PointCloud2"):
            open_recording(path, RecordingOptions(topics={"lidar": "/front"}))
    with subtests.test("last scan cut off"):
        messages = scan_messages(scans, TIMES)
        messages[-1][2]["data"] = messages[-1][2]["data"][:-40]
        path = example.write_mcap(tmp_path / "f.mcap", messages)
        assert len(open_recording(path)) == COUNT - 1
        assert "data: expected height x width x point_step" in caplog.text
    with subtests.test("file cut off"):
        path = example.write_mcap(tmp_path / "g.mcap", scan_messages(scans, TIMES))
        path.write_bytes(path.read_bytes()[:-500])
        with pytest.raises(InputError, match=r"g\.mcap: .*cut off"):
            open_recording(path)
    with subtests.test("a summary of other messages"):
        path = example.write_mcap(tmp_path / "j.mcap", scan_messages(scans, TIMES))
        monkeypatch.setattr("data_tools.recordings.bags.isolated", lambda *_: iter(()))
        with pytest.raises(InputError, match=r"j\.mcap: /points: expected 6 messages, as its summary tells, there are"):
            open_recording(path)
        monkeypatch.undo()
    with subtests.test("two sensors on one topic"):
        front, rear = scan_messages(scans, TIMES), scan_messages(scans, TIMES + 0.05, frame="rear")
        path = example.write_mcap(tmp_path / "t.mcap", sorted([*front, *rear], key=lambda message: message[3]))
        with pytest.raises(InputError, match=r"t\.mcap: /points: expected scans of one sensor, .* got lidar, rear"):
            open_recording(path)
    lying, turned = scan_messages(scans, TIMES), scan_messages(scans, TIMES[[0, 1, 3, 2, 4, 5]])
    lying[0][2]["point_step"] = 16
    off, none = (
        [*scan_messages(scans, TIMES), ("/fix", FIX, fix_message(BEGIN, latitude, 8.4, 110.0), round(BEGIN * 1e9))]
        for latitude in (91.0, np.nan)
    )
    for messages, message in [
        (turned, r"/points: message 4: time: expected one after 1700000000\.3"),
        (example.drive(), "expected messages of sensor_msgs/PointCloud2, there are auto"),
        (lying, "/points: message 1.*point_step: expected at least 20 bytes"),
        (off, "gps: expected latitudes within 85 and longitudes within 180"),
        (none, "/fix: measurement 1: expected finite numbers"),
    ]:
        path = example.write_mcap(tmp_path / "z.mcap", messages)
        with subtests.test(message), pytest.raises(InputError, match=rf"z\.mcap: {message}"):
            (found := open_recording(path)).sensors(), found[0]


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"point_step": 28}, "point_step: expected at least 32 bytes, as 'time' ends there, got 28"),
        ({"width": 3}, r"data: expected height x width x point_step = 1 x 3 x 32 bytes, got 64"),
        ({"height": 3, "row_step": 10}, "data: expected height x width"),
        ({"fields": [SimpleNamespace(name="x", offset=0, datatype=9, count=1)]}, r"fields\[0\]\.datatype: expected 1"),
    ],
)
def test_sizes_that_contradict_each_other_are_named(changed: dict[str, object], said: str) -> None:
    message = cloud_message(Scan(np.ones((2, 3)), np.zeros(2), np.array([0.0, 0.1])), BEGIN)
    message["fields"] = [SimpleNamespace(**field) for field in message["fields"]]
    assert cloud_columns(SimpleNamespace(**message))["time"].tolist() == [0.0, 0.1]
    with pytest.raises(InputError, match=said):
        cloud_columns(SimpleNamespace(**{**message, **changed}))


def test_rows_with_gaps_and_repeated_fields() -> None:
    message = cloud_message(Scan(np.arange(12.0).reshape(4, 3), np.zeros(4)), BEGIN)
    rows = np.frombuffer(message["data"], np.uint8).reshape(2, 64)
    message |= {"height": 2, "width": 2, "row_step": 70, "data": np.pad(rows, ((0, 0), (0, 6))).tobytes()}
    message["fields"] = [SimpleNamespace(**field) for field in [*message["fields"], message["fields"][0]]]
    assert cloud_columns(SimpleNamespace(**message))["y"].tolist() == [1, 4, 7, 10]


def laser_messages(log, robot_T_laser=None):
    found = []
    if robot_T_laser is not None:
        edge = static_transform("base_link", "laser", robot_T_laser)
        found.append(("/tf_static", example.TF, edge, round(BEGIN * 1e9)))
    for k, (time, pose) in enumerate(zip(BEGIN + log.time, transforms(log.odometry), strict=True)):
        angles = log.angles[k]
        placed = np.eye(4)
        placed[:2, :2], placed[:2, 3] = pose[:2, :2], pose[:2, 2]
        at = round(time * 1e9)
        found.append(("/odom", example.ODOMETRY, odometry_message(time, placed, 0.5), at))
        scan = laser_message(time, log.ranges[k], float(angles[0]), float(angles[1] - angles[0]))
        found.append(("/scan", LASER, scan, at))
    return found


@pytest.mark.parametrize("form", ["mcap", "bag"])
def test_a_laser_and_its_wheels(tmp_path: Path, form: str) -> None:
    log, _ = laser_drive(0, rounds=0.02)
    mount = yaw_transform(0.2, 0.0, 0.3, 0.1)
    found = read_bag_laser(written(tmp_path, form, laser_messages(log, mount)))
    np.testing.assert_allclose(found.time - BEGIN, log.time, atol=1e-6)
    np.testing.assert_allclose(found.ranges, log.ranges, atol=1e-5)
    np.testing.assert_allclose(found.angles[3], log.angles[3], atol=1e-5)
    np.testing.assert_allclose(found.odometry, log.odometry, atol=1e-6)
    np.testing.assert_allclose(found.robot_T_laser, [0.2, 0.0, 0.1], atol=1e-9)


def test_a_laser_without_wheels_is_refused(tmp_path: Path) -> None:
    log, _ = laser_drive(0, rounds=0.02)
    messages = [message for message in laser_messages(log) if message[0] == "/scan"]
    with pytest.raises(InputError, match=r"a\.mcap: expected odometry of base_link, by nav_msgs/Odometry or /tf"):
        read_bag_laser(example.write_mcap(tmp_path / "a.mcap", messages))

"""Objects of KITTI and logs of vehicles' sensors."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from data_tools.datasets.kitti import KittiTracking
from data_tools.metrics.kitti_boxes import CameraBoxes, camera_boxes_to_world, world_boxes_to_camera
from data_tools.sensor_logs import SensorLog, kitti_sensor_log, read_sensor_log
from saga_fg import InputError
from saga_fg.numerics import yaw_transform

LEVEL = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=float)  # looks along world x


def boxes(rotation_y: float = 0.0) -> CameraBoxes:
    return CameraBoxes(np.array([[1.5, 1.6, 4.0]]), np.array([[2.0, 1.75, 10.0]]), np.array([rotation_y]))


def tilted(yaw: float, pitch: float, roll: float, translation: tuple[float, float, float]) -> np.ndarray:
    def turn(angle: float, i: int, j: int) -> np.ndarray:
        R = np.eye(4)
        R[i, i] = R[j, j] = np.cos(angle)
        R[j, i], R[i, j] = np.sin(angle), -np.sin(angle)
        return R

    T = turn(yaw, 0, 1) @ turn(pitch, 2, 0) @ turn(roll, 1, 2) @ LEVEL
    T[:3, 3] = translation
    return T


def test_boxes_of_a_camera_are_boxes_of_the_world(subtests):
    world = camera_boxes_to_world(boxes(), ["car"], LEVEL)
    np.testing.assert_allclose(world.position, [[10, -2, -1]])  # 1.75 below the camera, plus half the height
    np.testing.assert_allclose(world.size, [[4, 1.6, 1.5]])
    assert np.isnan(world.velocity).all()
    for rotation_y, yaw in [(0.0, -np.pi / 2), (-np.pi / 2, 0.0), (np.pi / 2, -np.pi), (-np.pi / 4, -np.pi / 4)]:
        with subtests.test(rotation_y=rotation_y, yaw=yaw):
            # rotation_y 0 heads to the right of the camera, -90 degrees straight ahead
            world = camera_boxes_to_world(boxes(rotation_y), ["car"], yaw_transform(yaw=0.0) @ LEVEL)
            assert np.cos(world.yaw[0] - yaw) == pytest.approx(1)
    poses = np.stack([LEVEL, yaw_transform(5.0, 0.0, 0.0, np.pi / 2) @ LEVEL])
    two = CameraBoxes(*(np.concatenate([a, a]) for a in (boxes().size, boxes().location, boxes().rotation_y)))
    world = camera_boxes_to_world(two, ["car", "car"], poses)
    np.testing.assert_allclose(world.position, [[10, -2, -1], [7, 10, -1]], atol=1e-12)
    np.testing.assert_allclose(world_boxes_to_camera(world, poses).location, two.location)


angle = st.floats(-0.2, 0.2)
metres = st.floats(-1000, 1000)


@given(st.integers(0, 2**32 - 1), st.floats(-np.pi, np.pi), angle, angle, st.tuples(metres, metres, metres))
def test_there_and_back_is_exact(seed, yaw, pitch, roll, translation):
    rng = np.random.default_rng(seed)
    there = CameraBoxes(rng.uniform(0.3, 12, (6, 3)), rng.uniform(-80, 80, (6, 3)), rng.uniform(-np.pi, np.pi, 6))
    T = tilted(yaw, pitch, roll, translation)
    back = world_boxes_to_camera(camera_boxes_to_world(there, ["car"] * 6, T), T)
    np.testing.assert_allclose(back.size, there.size, rtol=0, atol=1e-12)
    np.testing.assert_allclose(back.location, there.location, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * back.rotation_y), np.exp(1j * there.rotation_y), rtol=0, atol=1e-9)


def test_boxes_of_nothing_and_of_no_size():
    none = CameraBoxes(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    assert len(world_boxes_to_camera(camera_boxes_to_world(none, [], LEVEL), LEVEL)) == 0
    flat = CameraBoxes(np.array([[1.5, 0, 4.0]]), np.zeros((1, 3)), np.zeros(1))
    with pytest.raises(InputError, match=r"size\[0\]: expected positive"):
        camera_boxes_to_world(flat, ["car"], LEVEL)


def test_corners_stand_on_the_location():
    corners = boxes(-np.pi / 2).corners()[0]
    np.testing.assert_allclose(corners.mean(axis=0), [2, 1, 10])
    np.testing.assert_allclose(corners.min(axis=0), [1.2, 0.25, 8])
    np.testing.assert_allclose(corners.max(axis=0), [2.8, 1.75, 12])
    np.testing.assert_allclose(corners[:4, 1], 1.75)


# Logs of the vehicle's sensors: units in the header, order of time, and KITTI's records


def written(folder: Path, text: str) -> Path:
    path = folder / "log.csv"
    path.write_text(text)
    return path


def test_columns_come_in_any_order_unit_and_spreadsheet(tmp_path):
    path = written(tmp_path, "note,speed [km/h],time [ms]\na,36,100\nb,-18,250\n")
    np.testing.assert_allclose(read_sensor_log(path, "wheels"), [[0.1, 10.0], [0.25, -5.0]])
    header = "time [s]," + ",".join(f"acceleration_{a} [g],angular_rate_{a} [deg/s]" for a in "xyz")
    table = read_sensor_log(written(tmp_path, f"{header}\n0.5,0,0,0,0,1,180\n"), "imu")
    np.testing.assert_allclose(table, [[0.5, 0, 0, 9.80665, 0, 0, np.pi]])
    path = written(tmp_path, "\ufefftime [s];speed [m/s]\n0.1;2\n")
    np.testing.assert_allclose(read_sensor_log(path, "wheels"), [[0.1, 2.0]])


def test_latitude_and_longitude_become_metres(tmp_path):
    path = written(
        tmp_path, "time [s],latitude [deg],longitude [deg],altitude [m]\n0,49,8.4,110\n1,49.0001,8.4001,111\n"
    )
    first, second = read_sensor_log(path, "gps")
    np.testing.assert_allclose(first[1:], 0, atol=1e-9)
    radius = 6378137.0 * np.pi / 180 * 1e-4
    np.testing.assert_allclose(second[1:], [radius * np.cos(np.radians(49)), radius, 1.0], rtol=1e-4)
    moved = read_sensor_log(path, "gps", lambda: (49.0, 8.4, 100.0))
    np.testing.assert_allclose(moved[:, 3], [10, 11])


def test_faults_are_named_with_their_line(tmp_path, subtests):
    for text, message in [
        ("", "expected a line of columns, the file is empty"),
        ("time,speed [m/s]\n", r"line 1: expected a column time with its unit, such as time \[s\]"),
        ("time [s],speed [knots]\n", "line 1: speed: expected one of m/s, km/h, mph, got 'knots'"),
        ("time [s],speed [m/s]\n1,2\n0.5,2\n", r"line 3: time: expected one after 1\.0+ s, got 0\.5"),
        ("time [s],speed [m/s]\n1,fast\n", "line 2: speed: expected a finite number, got 'fast'"),
        ("time [s],speed [m/s]\n1\n", "line 2: expected 2 columns, got 1"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            read_sensor_log(written(tmp_path, text), "wheels")
    fix = written(tmp_path, "time [s],latitude [rad],longitude [rad],altitude [m]\n0,0.8,0.1,110\n1,1.6,0.1,110\n")
    with pytest.raises(InputError, match=r"line 3: latitude: expected a number within 1\.48353, got 1\.6"):
        read_sensor_log(fix, "gps")


def test_a_log_is_fed_as_time_goes_on():
    log = SensorLog({"wheels": np.array([[0.1, 1.0], [0.2, 2.0], [0.3, 3.0]])})
    for _ in range(2):  # as often as it is asked
        given = list(log.until(np.array([0.0, 0.2, 0.3])))
        assert [time for time, _ in given] == [0.0, 0.2, 0.3]
        assert given[0][1].wheels is None
        assert [ego.wheels.speed for _, ego in given[1:]] == pytest.approx([1.5, 3.0])


def test_the_records_of_kitti(recordings):
    """Speeds and turn rates of the records agree with their poses."""
    poses = KittiTracking(recordings / "kitti", sequences=["0000"]).scene("0000").world_T_ego
    path = recordings / "kitti" / "training" / "oxts" / "0000.txt"
    log = kitti_sensor_log(path, ("gps", "imu", "wheels"), seed=0)
    driven = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / 0.1
    speed = log.tables["wheels"][1:, 1]
    assert np.abs(speed - driven).mean() < 0.3
    assert 0.5 < np.std(log.tables["gps"][:, 1:] - poses[:, :3, 3]) < 1.5
    assert np.abs(log.tables["imu"][:, 3].mean() - 9.8) < 0.3

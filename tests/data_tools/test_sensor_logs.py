"""Logs of the vehicle's sensors: units in the header, order of time, and KITTI's records."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from data_tools.datasets.kitti import KittiScans
from data_tools.sensor_logs import SensorLog, kitti_sensor_log, read_sensor_log
from saga_fg.errors import InputError


def written(folder: Path, text: str) -> Path:
    path = folder / "log.csv"
    path.write_text(text)
    return path


def test_columns_come_in_any_order_and_unit(tmp_path: Path) -> None:
    path = written(tmp_path, "note,speed [km/h],time [ms]\na,36,100\nb,-18,250\n")
    np.testing.assert_allclose(read_sensor_log(path, "wheels"), [[0.1, 10.0], [0.25, -5.0]])
    header = "time [s]," + ",".join(f"acceleration_{a} [g],angular_rate_{a} [deg/s]" for a in "xyz")
    table = read_sensor_log(written(tmp_path, f"{header}\n0.5,0,0,0,0,1,180\n"), "imu")
    np.testing.assert_allclose(table, [[0.5, 0, 0, 9.80665, 0, 0, np.pi]])


def test_byte_order_marks_and_semicolons_of_spreadsheets(tmp_path: Path) -> None:
    path = written(tmp_path, "\ufefftime [s];speed [m/s]\n0.1;2\n")
    np.testing.assert_allclose(read_sensor_log(path, "wheels"), [[0.1, 2.0]])


def test_latitude_and_longitude_become_metres(tmp_path: Path) -> None:
    path = written(
        tmp_path, "time [s],latitude [deg],longitude [deg],altitude [m]\n0,49,8.4,110\n1,49.0001,8.4001,111\n"
    )
    first, second = read_sensor_log(path, "gps")
    np.testing.assert_allclose(first[1:], 0, atol=1e-9)
    radius = 6378137.0 * np.pi / 180 * 1e-4
    np.testing.assert_allclose(second[1:], [radius * np.cos(np.radians(49)), radius, 1.0], rtol=1e-4)
    moved = read_sensor_log(path, "gps", lambda: (49.0, 8.4, 100.0))
    np.testing.assert_allclose(moved[:, 3], [10, 11])


def test_faults_are_named_with_their_line(tmp_path: Path, subtests: pytest.Subtests) -> None:
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


def test_a_log_is_fed_as_time_goes_on() -> None:
    log = SensorLog({"wheels": np.array([[0.1, 1.0], [0.2, 2.0], [0.3, 3.0]])})
    for _ in range(2):  # as often as it is asked
        given = list(log.until(np.array([0.0, 0.2, 0.3])))
        assert [time for time, _ in given] == [0.0, 0.2, 0.3]
        assert given[0][1].wheels is None
        assert [ego.wheels.speed for _, ego in given[1:]] == pytest.approx([1.5, 3.0])


def test_the_records_of_kitti(recordings: Path) -> None:
    """Speeds and turn rates of the records agree with their poses."""
    scans = KittiScans(recordings / "kitti", "0000", blind=True)
    path = recordings / "kitti" / "training" / "oxts" / "0000.txt"
    log = kitti_sensor_log(path, ("gps", "imu", "wheels"), 0.1, 1.0, 0.05, seed=0)
    driven = np.linalg.norm(np.diff(scans.world_T_ego[:, :3, 3], axis=0), axis=1) / 0.1
    speed = log.tables["wheels"][1:, 1]
    assert np.abs(speed - driven).mean() < 0.3
    assert 0.5 < np.std(log.tables["gps"][:, 1:] - scans.world_T_ego[:, :3, 3]) < 1.5
    assert np.abs(log.tables["imu"][:, 3].mean() - 9.8) < 0.3

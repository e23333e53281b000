"""CARMEN logs: what is written is read, both records, and what is wrong is located."""

from __future__ import annotations

import bz2
from pathlib import Path

import numpy as np
import pytest

from benchmarks.scans import laser_drive, write_carmen
from data_tools.laser import read_carmen
from saga_fg import InputError

READINGS = " ".join(f"{1 + k / 10:.2f}" for k in range(11))
FLASER = f"FLASER 11 {READINGS} 1.2 2.0 0 1.0 2.0 0 17.5 nohost 0.1\n"
ROBOT = f"ROBOTLASER1 0 -1.57 3.14 0.314 5 0.01 0 11 {READINGS} 0 1.2 2 0.5 1 2 0.5 0 0 0 0 0 17.5 nohost 0.1\n"


def test_a_written_log_is_read(tmp_path: Path) -> None:
    log, _ = laser_drive(0, rounds=0.02)
    write_carmen(tmp_path / "drive.log", log)
    (tmp_path / "drive.log.bz2").write_bytes(bz2.compress((tmp_path / "drive.log").read_bytes()))
    for name in ("drive.log", "drive.log.bz2"):
        again = read_carmen(tmp_path / name)
        np.testing.assert_allclose(again.ranges, log.ranges, atol=6e-4)
        np.testing.assert_allclose(again.odometry, log.odometry, atol=1e-6)
        np.testing.assert_allclose(again.angles, log.angles, atol=1e-12)
        np.testing.assert_allclose(again.time, log.time, atol=1e-6)


@pytest.mark.parametrize(("record", "last"), [(FLASER, np.pi / 2), (ROBOT, -1.57 + 3.14)])
def test_both_records_say_the_same(tmp_path: Path, record: str, last: float) -> None:
    (tmp_path / "two.log").write_text("PARAM x 1 nohost 0\n" + record + record.replace("17.5", "18.5"))
    log = read_carmen(tmp_path / "two.log")
    assert log.time.tolist() == [17.5, 18.5]
    np.testing.assert_allclose(log.ranges[0, :10], 1 + np.arange(10) / 10)
    np.testing.assert_allclose(log.angles[[0, -1]], [-last, last], atol=1e-9)
    assert log.odometry[0, :2].tolist() == [1, 2]
    assert np.isnan(log.ranges[0, 10])  # the largest, which recurs


@pytest.mark.parametrize(
    ("readings", "first", "last"),
    [
        (180, -90, 89),
        (181, -90, 90),
        (360, -90, 89.5),
        (361, -90, 90),
        (400, -50, 49.75),
        (401, -50, 50),
        (540, -90, 90),
    ],
)
def test_directions_are_those_that_carmen_guesses(tmp_path: Path, readings: int, first: float, last: float) -> None:
    ranges = " ".join(f"{1 + k / 1000:.3f}" for k in range(readings))
    (tmp_path / "drive.log").write_text(f"FLASER {readings} {ranges} 0 0 0 0 0 0 17.5 nohost 0.1\n")
    angles = np.rad2deg(read_carmen(tmp_path / "drive.log").angles)
    np.testing.assert_allclose(angles[[0, -1]], [first, last], atol=1e-9)


@pytest.mark.parametrize("nothing", [8.0, 81.91])
def test_a_value_that_stands_out_hit_nothing_though_a_few_lie_beyond(tmp_path: Path, nothing: float) -> None:
    rng = np.random.default_rng(0)
    ranges = np.round(rng.uniform(0.5, 7.9, (50, 180)), 2)
    ranges[rng.random(ranges.shape) < 0.05] = nothing
    ranges[7, 90] = 95.0
    lines = [f"FLASER 180 {' '.join(map(str, row))} 0 0 0 0 0 0 {k} nohost {k}\n" for k, row in enumerate(ranges)]
    (tmp_path / "drive.log").write_text("".join(lines))
    read = read_carmen(tmp_path / "drive.log").ranges
    np.testing.assert_array_equal(np.isnan(read), ranges >= nothing)
    np.testing.assert_allclose(read[ranges < nothing], ranges[ranges < nothing])


def test_without_such_a_value_all_readings_count(tmp_path: Path) -> None:
    ranges = np.round(np.random.default_rng(0).uniform(0.5, 7.9, (50, 180)), 2)
    lines = [f"FLASER 180 {' '.join(map(str, row))} 0 0 0 0 0 0 {k} nohost {k}\n" for k, row in enumerate(ranges)]
    (tmp_path / "drive.log").write_text("".join(lines))
    assert not np.isnan(read_carmen(tmp_path / "drive.log").ranges).any()


def test_a_laser_ahead_of_the_robot_is_mounted_there(tmp_path: Path) -> None:
    (tmp_path / "ahead.log").write_text(FLASER)
    np.testing.assert_allclose(read_carmen(tmp_path / "ahead.log").robot_T_laser, [0.2, 0, 0], atol=1e-9)


def test_a_laser_that_looks_back_is_mounted_so(tmp_path: Path) -> None:
    turned = [FLASER.replace("1.2 2.0 0 1.0 2.0 0", f"{0.9} 2.0 {way} 1.0 2.0 0") for way in ("3.141592", "-3.141592")]
    (tmp_path / "back.log").write_text("".join(turned))
    mounted = read_carmen(tmp_path / "back.log").robot_T_laser
    np.testing.assert_allclose([*mounted[:2], abs(mounted[2])], [-0.1, 0, np.pi], atol=1e-5)


def test_other_lasers_are_named_and_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "two.log").write_text(FLASER + FLASER.replace("FLASER", "RLASER") + "PARAM robot_width 0.5 nohost 0\n")
    assert len(read_carmen(tmp_path / "two.log")) == 1
    assert "two.log: the readings of RLASER are left out, FLASER are taken" in caplog.text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("# nothing\n", "expected records FLASER or ROBOTLASER1, there are none"),
        ("ODOM 1 2 3\nRAWLASER1 0 0\n", "expected records FLASER or ROBOTLASER1, there are only ODOM, RAWLASER1"),
        (FLASER + FLASER.replace("1.50", "east"), "line 2: expected numbers, .*east"),
        (FLASER.replace("1.50", "nan"), "line 1: expected finite numbers .*'nan'"),
        (FLASER.replace("FLASER 11", "FLASER 12"), "line 1: expected 22 values after FLASER, for 12 readings, got 21"),
        (FLASER.replace("FLASER 11", "FLASER many"), "line 1: expected a number of readings from 10, got 'many'"),
        (ROBOT.replace(" 17.5 nohost", " nohost"), "line 1: expected 34 values after ROBOTLASER1, got 33"),
        (FLASER + FLASER.replace("FLASER 11 1.00", "FLASER 10"), "line 2: expected 11 readings as before, got 10"),
    ],
)
def test_what_is_wrong_is_located(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "bad.log").write_text(text)
    with pytest.raises(InputError, match=message):
        read_carmen(tmp_path / "bad.log")


def test_a_broken_archive_is_named(tmp_path: Path) -> None:
    (tmp_path / "bad.bz2").write_bytes(b"no archive")
    with pytest.raises(InputError, match=r"bad\.bz2: cannot be read"):
        read_carmen(tmp_path / "bad.bz2")

"""Planar lasers: logs of CARMEN and registration."""

import bz2

import numpy as np
import pytest

from benchmarks.scans import laser_drive
from data_tools.laser import LineMap, OccupancyGrid, ScoreGrid, read_carmen
from saga_fg import InputError
from saga_fg.numerics.arrays import FloatArray
from tests.data_tools.carmen_example import write_carmen

READINGS = " ".join(f"{1 + k / 10:.2f}" for k in range(11))
FLASER = f"FLASER 11 {READINGS} 1.2 2.0 0 1.0 2.0 0 17.5 nohost 0.1\n"
ROBOT = f"ROBOTLASER1 0 -1.57 3.14 0.314 5 0.01 0 11 {READINGS} 0 1.2 2 0.5 1 2 0.5 0 0 0 0 0 17.5 nohost 0.1\n"


def test_a_written_log_is_read(tmp_path):
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
def test_both_records_say_the_same(tmp_path, record, last):
    (tmp_path / "two.log").write_text("PARAM x 1 nohost 0\n" + record + record.replace("17.5", "18.5"))
    log = read_carmen(tmp_path / "two.log")
    assert log.time.tolist() == [17.5, 18.5]
    np.testing.assert_allclose(log.ranges[0, :10], 1 + np.arange(10) / 10)
    np.testing.assert_allclose(log.angles[:, [0, -1]], [[-last, last]] * 2, atol=1e-9)
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
def test_directions_are_those_that_carmen_guesses(tmp_path, readings, first, last):
    ranges = " ".join(f"{1 + k / 1000:.3f}" for k in range(readings))
    (tmp_path / "drive.log").write_text(f"FLASER {readings} {ranges} 0 0 0 0 0 0 17.5 nohost 0.1\n")
    (angles,) = np.rad2deg(read_carmen(tmp_path / "drive.log").angles)
    np.testing.assert_allclose(angles[[0, -1]], [first, last], atol=1e-9)


@pytest.mark.parametrize("nothing", [8.0, 81.91])
def test_a_value_that_stands_out_hit_nothing_though_a_few_lie_beyond(tmp_path, nothing):
    rng = np.random.default_rng(0)
    ranges = np.round(rng.uniform(0.5, 7.9, (50, 180)), 2)
    ranges[rng.random(ranges.shape) < 0.05] = nothing
    ranges[7, 90] = 95.0
    lines = [f"FLASER 180 {' '.join(map(str, row))} 0 0 0 0 0 0 {k} nohost {k}\n" for k, row in enumerate(ranges)]
    (tmp_path / "drive.log").write_text("".join(lines))
    read = read_carmen(tmp_path / "drive.log").ranges
    np.testing.assert_array_equal(np.isnan(read), ranges >= nothing)
    np.testing.assert_allclose(read[ranges < nothing], ranges[ranges < nothing])


def test_without_such_a_value_all_readings_count(tmp_path):
    ranges = np.round(np.random.default_rng(0).uniform(0.5, 7.9, (50, 180)), 2)
    lines = [f"FLASER 180 {' '.join(map(str, row))} 0 0 0 0 0 0 {k} nohost {k}\n" for k, row in enumerate(ranges)]
    (tmp_path / "drive.log").write_text("".join(lines))
    assert not np.isnan(read_carmen(tmp_path / "drive.log").ranges).any()


def test_directions_are_those_of_each_record(tmp_path):
    """As lasers are logged that scan half a step further in every other turn, and with one reading more or less."""
    interlaced = ROBOT.replace("-1.57 3.14", "-1.413 3.14").replace("17.5", "18.5")
    (tmp_path / "two.log").write_text(ROBOT + interlaced + ROBOT.replace("17.5", "19.5"))
    log = read_carmen(tmp_path / "two.log")
    np.testing.assert_allclose(log.angles[1] - log.angles[0], 0.157)
    for row in (0, 1):
        points = log.points(row)
        np.testing.assert_allclose(np.arctan2(points[:, 1], points[:, 0]), log.angles[row][: len(points)])
    shorter = FLASER.replace("FLASER 11 1.00", "FLASER 10")
    (tmp_path / "three.log").write_text(FLASER + shorter + FLASER)
    log = read_carmen(tmp_path / "three.log").first(2)
    assert log.ranges.shape == log.angles.shape == (2, 11)
    np.testing.assert_allclose(log.angles[0], np.linspace(-np.pi / 2, np.pi / 2, 11))
    np.testing.assert_allclose(log.angles[1][:10], np.linspace(-np.pi / 2, np.pi / 2, 10))
    assert np.isnan(log.ranges[1, 10])
    assert log.points(1)[0, 1] == pytest.approx(-1.1)


def test_a_laser_is_mounted_where_its_readings_say(tmp_path):
    (tmp_path / "ahead.log").write_text(FLASER)
    np.testing.assert_allclose(read_carmen(tmp_path / "ahead.log").robot_T_laser, [0.2, 0, 0], atol=1e-9)
    turned = [FLASER.replace("1.2 2.0 0 1.0 2.0 0", f"{0.9} 2.0 {way} 1.0 2.0 0") for way in ("3.141592", "-3.141592")]
    (tmp_path / "back.log").write_text("".join(turned))
    mounted = read_carmen(tmp_path / "back.log").robot_T_laser
    np.testing.assert_allclose([*mounted[:2], abs(mounted[2])], [-0.1, 0, np.pi], atol=1e-5)


def test_other_lasers_are_named_and_left_out(tmp_path, caplog):
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
        (FLASER.replace("FLASER 11", "FLASER ²"), "line 1: expected a number of readings from 10, got '²'"),
        (FLASER.replace("FLASER 11", f"FLASER {'9' * 5000}"), "line 1: expected a number of readings from 10, got '9"),
        (ROBOT.replace(" 17.5 nohost", " nohost"), "line 1: expected 34 values after ROBOTLASER1, got 33"),
    ],
)
def test_what_is_wrong_is_located(tmp_path, text, message):
    (tmp_path / "bad.log").write_text(text)
    with pytest.raises(InputError, match=message):
        read_carmen(tmp_path / "bad.log")


def test_a_broken_archive_is_named(tmp_path):
    (tmp_path / "bad.bz2").write_bytes(b"no archive")
    with pytest.raises(InputError, match=r"bad\.bz2: cannot be read"):
        read_carmen(tmp_path / "bad.bz2")


# Registration and search of planar scans, against what is known


def room(rng: np.random.Generator, n: int = 600) -> FloatArray:
    """Points on the walls of an L-shaped room, noisy."""
    corners = np.array([(0, 0), (6, 0), (6, 3), (4, 3), (4, 5), (0, 5), (0, 0)], dtype=float)
    part, share = rng.integers(0, 6, n), rng.uniform(size=(n, 1))
    return corners[part] * (1 - share) + corners[part + 1] * share + 0.01 * rng.normal(size=(n, 2))


def seen_from(points: FloatArray, pose: FloatArray) -> FloatArray:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return (points - pose[:2]) @ np.array([[c, -s], [s, c]])


def test_point_to_line_finds_the_pose(subtests):
    for seed in range(3):
        with subtests.test(seed=seed):
            rng = np.random.default_rng(seed)
            true = np.array([2.0, 2.0, 0.3])
            lines = LineMap.of(room(rng))
            fit = lines.fit(seen_from(room(rng, 180), true), true + np.array([0.15, -0.1, 0.05]), np.eye(3), reach=0.5)
            assert (np.abs(fit.pose - true) < [0.01, 0.01, 0.005]).all()
            assert fit.share > 0.97  # the sampled walls have gaps
            assert np.linalg.eigvalsh(fit.information[:2, :2])[0] > 0


def test_along_a_bare_corridor_odometry_decides():
    rng = np.random.default_rng(0)
    x = rng.uniform(-8, 8, 400)
    walls = np.column_stack([x, np.where(rng.uniform(size=400) < 0.5, 1.0, -1.0)]) + 0.01 * rng.normal(size=(400, 2))
    start = np.array([0.7, 0.1, 0.0])
    fit = LineMap.of(walls).fit(walls[np.abs(x) < 3], start, np.diag([1e4, 1.0, 1.0]), reach=0.5)
    np.testing.assert_allclose(fit.pose, [0.7, 0, 0], atol=0.02)
    values = np.linalg.eigvalsh(fit.information[:2, :2])
    assert values[0] < 0.02 * values[1]


def test_branch_and_bound_finds_what_all_poses_of_the_window_would(subtests):
    for seed in range(3):
        with subtests.test(seed=seed):
            rng = np.random.default_rng(seed)
            true = np.array([2.2, 1.7, 0.4])
            grid = ScoreGrid.of(room(rng))
            scan = seen_from(room(rng, 150), true)
            found = grid.search(scan, true + np.array([1.3, -0.9, 0.25]), 2.0, 0.4, 0.5)
            assert (np.abs(found.pose - true) < [0.11, 0.11, 0.06]).all()
            assert found.rival < 0.9 * found.score
            assert grid.search(scan, true + np.array([4.0, 3.0, 0.0]), 1.0, 0.1, 0.8) is None


def test_bounds_hold_on_every_level():
    rng = np.random.default_rng(5)
    grid = ScoreGrid.of(room(rng))
    fine = grid.levels[0]
    for k, level in enumerate(grid.levels):
        pad = 2**k - 1
        for i, j in rng.integers(-pad, fine.shape[0] - 10, size=(50, 2)).tolist():
            if not -pad <= j < fine.shape[1]:
                continue
            block = fine[max(i, 0) : max(i + 2**k, 0), max(j, 0) : max(j + 2**k, 0)]
            assert level[i + pad, j + pad] == pytest.approx(block.max(initial=0.0))


def test_a_map_that_is_drawn_twice_has_the_larger_entropy():
    rng = np.random.default_rng(1)
    scans = [seen_from(room(rng, 180), np.array([2.0, 2.0, 0.0])) for _ in range(6)]
    poses = np.tile(np.eye(3), (6, 1, 1))
    apart = poses.copy()
    apart[3:, :2, 2] = 0.3
    assert OccupancyGrid.of(scans, apart).entropy > 1.1 * OccupancyGrid.of(scans, poses).entropy


@pytest.mark.parametrize("edge", [-0.4, 0.4])
def test_the_window_ends_at_its_reach_on_both_sides(edge):
    rng = np.random.default_rng(2)
    true = np.array([2.0, 2.0, 0.0])
    grid = ScoreGrid.of(room(rng))
    scan = seen_from(room(rng, 150), true)
    at_the_edge = grid.search(scan, true - np.array([edge, edge, 0.0]), 0.4, 0.02, 0.5)
    assert (np.abs(at_the_edge.pose[:2] - true[:2]) < 0.06).all()
    start = true - np.array([2 * edge, 2 * edge, 0.0])
    beyond = grid.search(scan, start, 0.4, 0.02, 0.01)
    assert (np.abs(beyond.pose[:2] - start[:2]) < 0.41).all()


def test_the_share_is_of_points_near_the_map_even_where_too_few_pair():
    lines = LineMap.of(room(np.random.default_rng(0)))
    scan = np.array([[0.5, 0.1], [1.0, 0.1], [1.5, 0.4], [2.0, 0.4]])
    fit = lines.fit(scan, np.zeros(3), np.eye(3), reach=0.5)
    assert fit.share == 0.5
    assert not fit.information.any()

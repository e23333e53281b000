"""Victoria Park and Plaza: what the files say, and what is said of broken ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.recordings.landmarks import read_landmark_log
from saga_fg import InputError

PARK = """\
ODOMETRY 0 1 1.5 0 0 0.01 0 0 0.02 0 0.03
ODOMETRY 1 3 0.5 0.25 1.5707963267948966 0.01 0.001 0 0.02 0 0.03
LANDMARK 1 2 4 -1 0.4 0.1 0.5
LANDMARK 3 2 5 6 0.4 0 0.4
"""
PLAZA = {
    "DR": "10.0 0.5 0.1\n10.2\t0.25\t-0.1\t\n",
    "TD": "10.15 2 3 12\n10.1 2 7 30.5\n",
    "GT": "10 1 2 0.5\n10.2 3 4 0.6\n",
    "TL": "7 20 30\n3 -1 -2\n",
}


def park(folder: Path, text: str) -> Path:
    path = folder / "park.txt"
    path.write_text(text)
    return path


def plaza(folder: Path, **texts: str) -> Path:
    for kind, text in (PLAZA | texts).items():
        (folder / f"P_{kind}.txt").write_text(text)
    return folder / "P_DR.txt"


def test_a_drive_past_trees_is_read(tmp_path: Path) -> None:
    drive = read_landmark_log(park(tmp_path, PARK))
    np.testing.assert_allclose(drive.a_T_b[1], [[0, -1, 0.5], [1, 0, 0.25], [0, 0, 1]], atol=1e-15)
    np.testing.assert_array_equal(drive.odometry_covariance[1], [[0.01, 0.001, 0], [0.001, 0.02, 0], [0, 0, 0.03]])
    assert drive.pose.tolist() == [1, 2]
    assert drive.landmark.tolist() == [2, 2]
    np.testing.assert_array_equal(drive.value, [[4, -1], [5, 6]])
    np.testing.assert_array_equal(drive.covariance[0], [[0.4, 0.1], [0.1, 0.5]])


def test_a_broken_drive_is_located(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for old, new, message in [
        ("LANDMARK 1", "TREE 1", "line 3: expected ODOMETRY or LANDMARK, got 'TREE'"),
        ("0.02 0 0.03\nODO", "0.02 0\nODO", "line 1: expected 11 values after ODOMETRY, got 10"),
        ("1 3 0.5", "2 3 0.5", "line 2: i: expected pose 1, where the row before ended, got 2"),
        ("1 3 0.5", "1 0 0.5", "every pose once"),
        ("LANDMARK 3", "LANDMARK 4", "line 4: i: there is no pose 4"),
        ("4 -1 0.4", "inf -1 0.4", "line 3: x: expected a finite number, got 'inf'"),
        ("0.4 0.1 0.5", "0.4 0.9 0.5", "line 3: P11 ... P22: expected a positive definite"),
        (PARK, PARK.splitlines()[0], "expected LANDMARK records"),
    ]:
        with subtests.test(message):
            path = park(tmp_path, PARK.replace(old, new, 1))
            with pytest.raises(InputError, match=message) as caught:
                read_landmark_log(path)
            assert str(path) in str(caught.value)


def test_ranges_to_beacons_are_read(tmp_path: Path) -> None:
    plaza(tmp_path)
    drive = read_landmark_log(tmp_path / "P_TL.txt")
    np.testing.assert_array_equal(drive.time, [10.0, 10.2])
    np.testing.assert_allclose(np.arctan2(drive.a_T_b[:, 1, 0], drive.a_T_b[:, 0, 0]), [-0.1])
    np.testing.assert_allclose(np.hypot(*drive.a_T_b[0, :2, 2]), 0.25)
    assert drive.pose.tolist() == [1, 1]
    assert drive.landmark.tolist() == [7, 3]
    np.testing.assert_array_equal(drive.value[:, 0], [30.5, 12.0])
    assert drive.truth is not None
    np.testing.assert_allclose(drive.truth.positions[1], [3, 4, 0])
    assert {k: v.tolist() for k, v in drive.places.items()} == {7: [20, 30], 3: [-1, -2]}


def test_the_truth_of_beacons_and_drive_is_optional(tmp_path: Path) -> None:
    path = plaza(tmp_path)
    (tmp_path / "P_GT.txt").unlink()
    (tmp_path / "P_TL.txt").unlink()
    drive = read_landmark_log(path)
    assert drive.truth is None
    assert drive.places == {}


def test_broken_ranges_are_located(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for texts, message in [
        ({"TD": "10.1 2 7 -3\n"}, "P_TD.txt: line 1: range: expected a number > 0"),
        ({"TD": "10.1 2 7.5 3\n"}, "P_TD.txt: line 1: beacon: expected a whole number"),
        ({"TD": "10.1 2 7\n"}, "P_TD.txt: line 1: expected 4 columns"),
        ({"TD": ""}, "P_TD.txt: expected records"),
        ({"DR": "10 1 0\n9 1 0\n"}, "P_DR.txt: line 2: time: expected 10.000000 or later"),
        ({"DR": "10 one 0\n"}, "P_DR.txt: line 1: distance: expected a finite number, got 'one'"),
        ({"GT": ""}, "P_GT.txt: expected records"),
        ({"TL": "1e300 20 30\n"}, "P_TL.txt: line 1: beacon: expected a number within"),
        ({"TL": "7 20\n"}, "P_TL.txt: line 1: expected 3 columns"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            read_landmark_log(plaza(tmp_path, **texts))

"""The readers of KITTI's files: calibration, poses, labels, and what they say of broken ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from data_tools.datasets.kitti import read_calibration, read_kitti_labels, read_poses
from data_tools.kitti_objects import has_box
from saga_fg import InputError
from saga_fg.numerics.geometry import transform_points
from tests.data_tools.kitti_example import CALIBRATION, LABELS, calibration_text, oxts_line


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_calibration_chain(tmp_path: Path) -> None:
    calibration = read_calibration(write(tmp_path / "c.txt", calibration_text()))
    point = np.array([[11.0, -2.0, 1.0]])  # of the IMU: 10 m ahead of the camera, 2 m to its right, 1 m below it
    np.testing.assert_allclose(transform_points(calibration.camera_T_imu, point), [[2, 1, 10]])
    np.testing.assert_allclose(transform_points(calibration.camera_T_velodyne, point), [[2, -1, 11]])
    assert calibration.projection.shape == (3, 4)


def test_both_spellings_of_the_keys(tmp_path: Path) -> None:
    plain = read_calibration(write(tmp_path / "a.txt", calibration_text()))
    for renamed in (
        {"R_rect": "R_rect:", "Tr_velo_cam": "Tr_velo_cam:", "Tr_imu_velo": "Tr_imu_velo:", "P2:": "P2"},
        {"R_rect": "R0_rect:", "Tr_velo_cam": "Tr_velo_to_cam:", "Tr_imu_velo": "Tr_imu_to_velo:"},
    ):
        text = calibration_text()
        for old, new in renamed.items():
            text = text.replace(f"{old} ", f"{new} ")
        other = read_calibration(write(tmp_path / "b.txt", text))
        np.testing.assert_array_equal(other.camera_T_imu, plain.camera_T_imu)


def test_rotations_are_made_exact(tmp_path: Path) -> None:
    rounded = [v + 3e-6 * k for k, v in enumerate(CALIBRATION["R_rect"])]
    camera_T_imu = read_calibration(write(tmp_path / "c.txt", calibration_text(R_rect=rounded))).camera_T_imu
    np.testing.assert_allclose(camera_T_imu[:3, :3] @ camera_T_imu[:3, :3].T, np.eye(3), atol=1e-14)


BROKEN_CALIBRATIONS = [
    (calibration_text().replace("Tr_velo_cam", "Tr_cam"), r"expected the key Tr_velo_cam or Tr_velo_to_cam, the keys"),
    ("", "expected the key P2, the keys there are none"),
    (calibration_text(R_rect=[1, 0, 0]), r"line 3: R_rect: expected 9 finite numbers, got 3"),
    (calibration_text().replace("700 180", "700 x"), r"line 2: P2: expected 12 numbers: could not convert"),
    (calibration_text(R_rect=[2, 0, 0, 0, 2, 0, 0, 0, 2]), r"line 3: R_rect: expected a rotation"),
    (calibration_text(R_rect=[1, 0, 0, 0, 1, 0, 0, 0, -1]), r"line 3: R_rect: expected a rotation"),
]


def test_broken_calibration(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for text, message in BROKEN_CALIBRATIONS:
        with subtests.test(message), pytest.raises(InputError, match=rf"c\.txt: {message}"):
            read_calibration(write(tmp_path / "c.txt", text))


def test_poses_start_at_the_origin_and_are_level(tmp_path: Path) -> None:
    text = "\n".join([oxts_line(0, yaw=0.5), oxts_line(3, yaw=0.5, pitch=0.1), oxts_line(4, yaw=0.5, roll=0.1)])
    poses = read_poses(write(tmp_path / "o.txt", text))
    np.testing.assert_allclose(poses[:, :3, 3], [[0, 0, 0], [3, 0, 0], [4, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(poses[0, :3, :3] @ [1, 0, 0], [np.cos(0.5), np.sin(0.5), 0])
    np.testing.assert_allclose(poses[0, :3, :3] @ [0, 0, 1], [0, 0, 1])
    assert (poses[1, :3, :3] @ [1, 0, 0])[2] == pytest.approx(-np.sin(0.1))  # pitch turns z to x: the nose dips
    assert (poses[2, :3, :3] @ [0, 1, 0])[2] == pytest.approx(np.sin(0.1))  # roll turns y to z: the left side rises


def test_poses_go_north_with_latitude(tmp_path: Path) -> None:
    values = oxts_line().split()
    values[0] = repr(float(49.0 + np.degrees(100 / 6378137.0)))
    poses = read_poses(write(tmp_path / "o.txt", oxts_line() + "\n" + " ".join(values)))
    np.testing.assert_allclose(poses[1, :3, 3], [0, 100, 0], atol=2e-3)


BROKEN_POSES = [
    (oxts_line() + "\n49 8 100 0 0\n", r"line 2: expected 30 columns \(latitude, .*\), got 5"),
    (oxts_line() + "\n" + oxts_line().replace("49.0", "149.0"), r"line 2: latitude: expected degrees within 85 of 0"),
    (oxts_line().replace("8.0", "888.0"), r"line 1: longitude: expected degrees within 180"),
    (oxts_line().replace("100.0", "nan"), r"line 1: altitude: expected a finite number, got 'nan'"),
    ("", "expected a record per frame, the file is empty"),
]


def test_broken_poses(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for text, message in BROKEN_POSES:
        with subtests.test(message), pytest.raises(InputError, match=rf"o\.txt: {message}"):
            read_poses(write(tmp_path / "o.txt", text))


def test_labels(tmp_path: Path) -> None:
    objects = read_kitti_labels(write(tmp_path / "l.txt", "\n".join(LABELS)))
    assert objects.frame.tolist() == [0, 0, 1, 2, 2]
    assert objects.track_id.tolist() == [-1, 4, 4, 4, 5]
    assert objects.type.tolist() == ["DontCare", "Car", "Car", "Car", "Person_sitting"]
    assert objects.truncated.tolist() == [-1, 0, 0, 0, 1]
    assert objects.occluded.tolist() == [-1, 0, 1, 2, 3]
    assert objects.alpha[1] == -1.5
    assert objects.bbox[1].tolist() == [500, 150, 600, 250]
    assert objects.boxes.size[1].tolist() == [1.5, 1.6, 4]
    assert objects.boxes.location[1].tolist() == [2, 1.75, 10]
    assert objects.boxes.rotation_y[1] == -1.57079632679
    assert np.isnan(objects.score).all()
    assert has_box(objects).tolist() == [False, True, True, True, True]
    assert objects.select(has_box(objects)).type.tolist() == ["Car", "Car", "Car", "Person_sitting"]


def test_results_have_a_score_and_an_empty_file_holds_none(tmp_path: Path) -> None:
    assert read_kitti_labels(write(tmp_path / "r.txt", LABELS[1] + " 8.5\n\n")).score.tolist() == [8.5]
    assert len(read_kitti_labels(write(tmp_path / "l.txt", ""))) == 0


CAR = LABELS[1]
BROKEN_LABELS = [
    (" ".join(CAR.split()[:16]), r"line 1: expected 17 or 18 columns \(frame id type .*\), got 16"),
    (f"{CAR}\n{CAR} 0.5", r"line 2: expected 17 columns .* got 18"),
    (CAR.replace("0 4 Car", "0 4 Cra"), r"line 1: type: unknown class 'Cra'; did you mean 'Car'"),
    (CAR.replace("0 4 Car", "-1 4 Car"), r"line 1: frame: expected a whole number from 0 to \d+, got -1"),
    (CAR.replace("0 4 Car", "0.5 4 Car"), r"line 1: frame: expected a whole number .*, got 0\.5"),
    (CAR.replace("0 4 Car", "0 1e300 Car"), r"line 1: id: expected a whole number .*, got 1e300"),
    (CAR.replace("2 1.75 10", "2 nan 10"), r"line 1: y: expected a finite number, got 'nan'"),
    (
        CAR.replace("1.5 1.6 4", "1.5 -1.6 4"),
        r"line 1: h w l: expected a positive size in m, got \[1\.5, -1\.6, 4\.0\]",
    ),
    (f"\n{CAR}\n{CAR}", r"line 3: id: expected each track once a frame, 4 is in frame 0 again"),
]


def test_broken_labels(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for text, message in BROKEN_LABELS:
        with subtests.test(message), pytest.raises(InputError, match=rf"l\.txt: {message}"):
            read_kitti_labels(write(tmp_path / "l.txt", text))

"""KITTI as a dataset: texts, images, scans, truth."""

import logging
from pathlib import Path

import numpy as np
import pytest

from data_tools.datasets.kitti import (
    KittiTracking,
    image_boxes,
    kitti_scans,
    observation_angles,
    read_calibration,
    read_kitti_labels,
    read_poses,
    write_kitti_results,
)
from data_tools.datasets.kitti.source import read_scored_sequences
from data_tools.metrics.kitti_boxes import CameraBoxes, has_box
from saga_fg import InputError, Tracks
from saga_fg.numerics.geometry import inverse_transform, transform_points
from tests.data_tools.kitti_example import CALIBRATION, LABELS, calibration_text, oxts_line, write_sequence


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_sequence(tmp_path)


def test_every_moment_has_a_frame(root):
    frames = KittiTracking(root, root / "found").scene("0007").frames
    assert [len(frame) for frame in frames] == [1, 0, 2]
    assert [frame.sensor for frame in frames] == ["lidar"] * 3
    np.testing.assert_allclose([frame.timestamp for frame in frames], [0, 0.1, 0.2])
    car, cyclist = frames[2].detections
    assert (car.label, cyclist.label) == ("car", "cyclist")
    # the vehicle is 2 m along, the camera 1 m ahead of it and 2 m up
    np.testing.assert_allclose(car.position, [2 + 1 + 10, -2, 2 - 1.75 + 0.75], atol=1e-6)
    np.testing.assert_allclose(cyclist.position, [2 + 1 + 8, 3, 2 - 1.6 + 0.85], atol=1e-6)
    assert car.size == (4.0, 1.6, 1.5)
    assert car.yaw == pytest.approx(0, abs=1e-9)
    assert np.isnan(car.velocity).all()
    assert (car.score, cyclist.score) == (-0.5, 1.25)  # logits, as they are


def test_ground_truth(root):
    truth = KittiTracking(root, ground_truth=True).scene("0007").ground_truth
    assert [moment.id.tolist() for moment in truth] == [["4"], ["4"], ["4", "5"]]
    assert truth[2].boxes.label.tolist() == ["car", "person_sitting"]
    assert [moment.visible.tolist() for moment in truth] == [[True], [True], [False, False]]
    # at rest before a vehicle that does 1 m in 0.1 s, the car does as much
    for moment in truth:
        np.testing.assert_allclose(moment.boxes.velocity[0], [10, 0], atol=1e-4)
    assert np.isnan(truth[2].boxes.velocity[1]).all()


def test_without_detections_there_are_no_frames_and_the_root_may_be_the_training_folder(root):
    assert len(KittiTracking(root / "training").scene("0007").frames) == 0


def test_class_without_a_file_is_empty_and_said(root, caplog):
    (root / "found" / "Cyclist" / "0007.txt").unlink()
    with caplog.at_level(logging.WARNING):
        frames = KittiTracking(root, root / "found").scene("0007").frames
    assert [len(frame) for frame in frames] == [1, 0, 1]
    assert len(caplog.records) == 1


def test_unknown_sequences_and_late_labels_are_named(root):
    with pytest.raises(InputError, match="unknown sequence '0070'; did you mean '0007'"):
        KittiTracking(root, sequences=["0070"])
    with pytest.raises(InputError, match="unknown sequence '0001'"):
        KittiTracking(root).scene("0001")
    path = root / "training" / "label_02" / "0007.txt"
    path.write_text(path.read_text().replace("2 5 Person", "7 5 Person"))
    with pytest.raises(InputError, match=r"label_02/0007\.txt: frame 7: expected frames 0 to 2 only"):
        KittiTracking(root, ground_truth=True).scene("0007")


def test_missing_files_and_folders(root):
    with pytest.raises(InputError, match="oxts: expected GPS/IMU records"):
        KittiTracking(root / "found")
    with pytest.raises(InputError, match=r"nowhere: expected a folder .* there is no such folder"):
        KittiTracking(root / "nowhere")
    with pytest.raises(InputError, match="none: expected a folder with Car/"):
        KittiTracking(root, root / "none")
    (root / "empty").mkdir()
    with pytest.raises(InputError, match=r"expected Pedestrian/0007\.txt or Car/0007\.txt or Cyclist/0007\.txt"):
        KittiTracking(root, root / "empty").scene("0007")
    for folder in ("label_02", "calib"):
        (root / "training" / folder / "0007.txt").unlink()
        with pytest.raises(InputError, match=rf"{folder}/0007\.txt: cannot be read: No such file"):
            KittiTracking(root, ground_truth=True).scene("0007")


CAR = "0,2,500,150,600,250,8.5,1.5,1.6,4,2,1.75,10,-1.5,-1.5"
BROKEN_DETECTIONS = [
    (CAR.removesuffix(",-1.5"), r"line 1: expected 15 columns \(frame, type, .*\), got 14"),
    (CAR.replace("0,2,", "3,2,", 1), r"line 1: frame: expected a whole number from 0 to 2, got 3"),
    (CAR.replace("0,2,", "99999999999999999999,2,", 1), r"line 1: frame: expected a whole number from 0 to 2"),
    (CAR.replace("0,2,", "0,3,", 1), r"line 1: type: expected 2 in a file of class Car, got 3"),
    (CAR.replace("1.5,1.6,4", "1.5,0,4"), r"line 1: h w l: expected a positive size in m"),
    (CAR.replace("1.75,10", "1.75,nan"), r"line 1: z: expected a finite number, got 'nan'"),
    (CAR.replace("8.5", "high"), r"line 1: score: expected a finite number, got 'high'"),
]


def test_broken_detections(root, subtests):
    for text, message in BROKEN_DETECTIONS:
        with subtests.test(message):
            (root / "found" / "Car" / "0007.txt").write_text(text)
            with pytest.raises(InputError, match=rf"Car/0007\.txt: {message}"):
                KittiTracking(root, root / "found").scene("0007")


# KITTI's LiDAR scans: which there are, when and where they were taken


def with_scans(root: Path, *frames: int) -> Path:
    folder = write_sequence(root) / "training" / "velodyne" / "0007"
    folder.mkdir(parents=True)
    for frame in frames:
        np.array([[frame + 1.0, 0.0, 0.0, 0.5], [0.0, 2.0, 0.0, 0.1]], dtype="<f4").tofile(folder / f"{frame:06d}.bin")
    return root


def test_scans_have_the_time_and_pose_of_their_frame(tmp_path):
    scans = kitti_scans(with_scans(tmp_path, 0, 2), "0007")
    assert len(scans) == 2
    np.testing.assert_allclose(scans.timestamps, [0.0, 0.2])
    np.testing.assert_allclose(scans.world_T_ego[1][:3, 3], [2.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(scans.ego_T_lidar[:3, 3], [1.0, 0.0, 2.0])
    np.testing.assert_allclose(inverse_transform(scans.ego_T_lidar)[:3, 3], [-1.0, 0.0, -2.0])
    second = scans[1]
    np.testing.assert_allclose(second.points, [[3, 0, 0], [0, 2, 0]])
    np.testing.assert_allclose(second.time, [0.0, -0.025])  # looking ahead at its moment, left a quarter turn before
    assert len(kitti_scans(tmp_path, "0007", most=1)) == 1


def test_a_sequence_without_scans_and_scans_without_records_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"velodyne.0007: expected LiDAR scans KKKKKK\.bin, there are none"):
        kitti_scans(write_sequence(tmp_path / "a"), "0007")
    with pytest.raises(InputError, match=r"000003\.bin: expected frames 0 to 2"):
        kitti_scans(with_scans(tmp_path / "b", 3), "0007")


# KITTI results beside their labels, in world coordinates, with what stands in the table beside them


@pytest.fixture
def scored_root(tmp_path: Path) -> Path:
    return write_sequence(tmp_path / "kitti")


def write_truth_as_result(root: Path, folder: Path) -> None:
    """The true boxes at 10 m/s eastwards, track numbers from 3 on."""
    data = KittiTracking(root, ground_truth=True)
    scene = data.scene("0007")
    moments = []
    for truth in scene.ground_truth or ():
        n = len(truth)
        velocity = np.tile([10.0, 0.0], (n, 1))
        boxes = type(truth.boxes)(*(getattr(truth.boxes, f) for f in ("label", "position", "size", "yaw")), velocity)  # type: ignore[call-arg]
        P = np.tile(np.diag([0.25, 0.5]), (n, 1, 1))
        moments.append(Tracks(0.0, np.arange(n) + 3, boxes, np.full(n, 0.5), P, P, np.zeros(n)))
    write_kitti_results(folder, data, [(scene, moments)])


def test_results_in_the_world_are_where_the_labels_are(scored_root, tmp_path):
    write_truth_as_result(scored_root, tmp_path / "out")
    (scored,) = read_scored_sequences(tmp_path / "out", scored_root, detections=scored_root / "found").values()
    assert len(scored.labels) == 5  # with the DontCare region
    assert len(scored.result) == len(scored.truth) == len(scored.found) == 4
    np.testing.assert_array_equal(scored.found.frame, scored.truth.frame)
    np.testing.assert_allclose(scored.found.boxes.position, scored.truth.boxes.position, atol=1e-5)
    np.testing.assert_allclose(scored.found.boxes.yaw, scored.truth.boxes.yaw, atol=1e-5)
    np.testing.assert_array_equal(scored.found.boxes.velocity, np.tile([10.0, 0.0], (4, 1)))
    np.testing.assert_array_equal(scored.found.position_covariance, np.tile(np.diag([0.25, 0.5]), (4, 1, 1)))
    assert sum(len(frame) for frame in scored.scene.frames) == 3


def test_without_the_table_velocities_and_covariances_are_unknown(scored_root, tmp_path):
    write_truth_as_result(scored_root, tmp_path / "out")
    (tmp_path / "out" / "tracks.csv").unlink()
    (scored,) = read_scored_sequences(tmp_path / "out", scored_root).values()
    assert np.isnan(scored.found.boxes.velocity).all()
    assert np.isnan(scored.found.position_covariance).all()


def test_missing_results(scored_root, tmp_path):
    with pytest.raises(InputError, match=r"0007\.txt: expected the results of sequence 0007"):
        read_scored_sequences(tmp_path, scored_root, ["0007"])
    with pytest.raises(InputError, match=r"expected results NNNN\.txt, there are none"):
        read_scored_sequences(tmp_path, scored_root)
    line = "3 3 Car 0 0 -1.5 500 150 600 250 1.5 1.6 4 2 1.75 10 -1.57 0.5\n"
    (tmp_path / "0007.txt").write_text(line)
    with pytest.raises(InputError, match="frame 3: expected frames 0 to 2 only"):
        read_scored_sequences(tmp_path, scored_root)


P2 = np.array([[700.0, 0, 600, 0], [0, 700, 180, 0], [0, 0, 1, 0]])
IMAGE = (1242, 375)


def box(x: float, y: float, z: float, rotation_y: float = 0.0, size: tuple[float, float, float] = (2, 2, 2)):
    return CameraBoxes(np.array([size], dtype=float), np.array([[x, y, z]]), np.array([rotation_y]))


def test_boxes_are_clipped_to_the_image():
    # front face at z = 9, from -1 to 1 in x, from 0 to -2 above the ground in y
    np.testing.assert_allclose(
        image_boxes(box(0, 1, 10), P2, IMAGE), [[600 - 700 / 9, 180 - 700 / 9, 600 + 700 / 9, 180 + 700 / 9]]
    )
    left, top, right, bottom = image_boxes(box(-10, 1, 10), P2, IMAGE)[0]
    assert left == 0
    assert right == pytest.approx(600 - 700 * 9 / 11)
    assert image_boxes(box(0, 1.5, 3), P2, IMAGE)[0, 3] == 374
    assert 0 < top < bottom < 374
    # a long box on the right, from 6 m behind to 6 m ahead of the camera: only its part ahead shows
    left, _, right, bottom = image_boxes(box(3, 1.5, 0, -np.pi / 2, (2, 2, 12)), P2, IMAGE)[0]
    assert left == pytest.approx(600 + 700 * 2 / 6)
    assert (right, bottom) == (1241, 374)


def test_box_that_does_not_show(subtests):
    for place in [(0, 1, -10), (-30, 1, 10), (30, 1, 10), (0, 40, 10), (0, -40, 10), (0, 1, -0.95)]:
        with subtests.test(place=place):
            assert np.isnan(image_boxes(box(*place), P2, IMAGE)).all()


def test_observation_angle_is_seen_from_the_camera():
    assert observation_angles(box(0, 1, 10, 0.3))[0] == pytest.approx(0.3)
    assert observation_angles(box(10, 1, 10, 0.3))[0] == pytest.approx(0.3 - np.pi / 4)
    assert observation_angles(box(10, 1, 10, -3.0))[0] == pytest.approx(-3.0 - np.pi / 4 + 2 * np.pi)


# The readers of KITTI's files: calibration, poses, labels, and what they say of broken ones


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_calibrations_are_a_chain_of_exact_rotations(tmp_path):
    calibration = read_calibration(write(tmp_path / "c.txt", calibration_text()))
    point = np.array([[11.0, -2.0, 1.0]])  # of the IMU: 10 m ahead of the camera, 2 m to its right, 1 m below it
    np.testing.assert_allclose(transform_points(calibration.camera_T_imu, point), [[2, 1, 10]])
    np.testing.assert_allclose(transform_points(calibration.camera_T_velodyne, point), [[2, -1, 11]])
    assert calibration.projection.shape == (3, 4)
    rounded = [v + 3e-6 * k for k, v in enumerate(CALIBRATION["R_rect"])]
    camera_T_imu = read_calibration(write(tmp_path / "c.txt", calibration_text(R_rect=rounded))).camera_T_imu
    np.testing.assert_allclose(camera_T_imu[:3, :3] @ camera_T_imu[:3, :3].T, np.eye(3), atol=1e-14)


def test_both_spellings_of_the_keys(tmp_path):
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


BROKEN_CALIBRATIONS = [
    (calibration_text().replace("Tr_velo_cam", "Tr_cam"), r"expected the key Tr_velo_cam or Tr_velo_to_cam, the keys"),
    ("", "expected the key P2, the keys there are none"),
    (calibration_text(R_rect=[1, 0, 0]), r"line 3: R_rect: expected 9 finite numbers, got 3"),
    (calibration_text().replace("700 180", "700 x"), r"line 2: P2: expected 12 numbers: could not convert"),
    (calibration_text(R_rect=[2, 0, 0, 0, 2, 0, 0, 0, 2]), r"line 3: R_rect: expected a rotation"),
    (calibration_text(R_rect=[1, 0, 0, 0, 1, 0, 0, 0, -1]), r"line 3: R_rect: expected a rotation"),
]


def test_broken_calibration(tmp_path, subtests):
    for text, message in BROKEN_CALIBRATIONS:
        with subtests.test(message), pytest.raises(InputError, match=rf"c\.txt: {message}"):
            read_calibration(write(tmp_path / "c.txt", text))


def test_poses_start_level_at_the_origin_and_go_north_with_latitude(tmp_path):
    text = "\n".join([oxts_line(0, yaw=0.5), oxts_line(3, yaw=0.5, pitch=0.1), oxts_line(4, yaw=0.5, roll=0.1)])
    poses = read_poses(write(tmp_path / "o.txt", text))
    np.testing.assert_allclose(poses[:, :3, 3], [[0, 0, 0], [3, 0, 0], [4, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(poses[0, :3, :3] @ [1, 0, 0], [np.cos(0.5), np.sin(0.5), 0])
    np.testing.assert_allclose(poses[0, :3, :3] @ [0, 0, 1], [0, 0, 1])
    assert (poses[1, :3, :3] @ [1, 0, 0])[2] == pytest.approx(-np.sin(0.1))  # pitch turns z to x: the nose dips
    assert (poses[2, :3, :3] @ [0, 1, 0])[2] == pytest.approx(np.sin(0.1))  # roll turns y to z: the left side rises
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


def test_broken_poses(tmp_path, subtests):
    for text, message in BROKEN_POSES:
        with subtests.test(message), pytest.raises(InputError, match=rf"o\.txt: {message}"):
            read_poses(write(tmp_path / "o.txt", text))


def test_labels(tmp_path):
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


def test_results_have_a_score_and_an_empty_file_holds_none(tmp_path):
    assert read_kitti_labels(write(tmp_path / "r.txt", LABELS[1] + " 8.5\n\n")).score.tolist() == [8.5]
    assert len(read_kitti_labels(write(tmp_path / "l.txt", ""))) == 0


CAR_LINE = LABELS[1]
BROKEN_LABELS = [
    (" ".join(CAR_LINE.split()[:16]), r"line 1: expected 17 or 18 columns \(frame id type .*\), got 16"),
    (f"{CAR_LINE}\n{CAR_LINE} 0.5", r"line 2: expected 17 columns .* got 18"),
    (CAR_LINE.replace("0 4 Car", "0 4 Cra"), r"line 1: type: unknown class 'Cra'; did you mean 'Car'"),
    (CAR_LINE.replace("0 4 Car", "-1 4 Car"), r"line 1: frame: expected a whole number from 0 to \d+, got -1"),
    (CAR_LINE.replace("0 4 Car", "0.5 4 Car"), r"line 1: frame: expected a whole number .*, got 0\.5"),
    (CAR_LINE.replace("0 4 Car", "0 1e300 Car"), r"line 1: id: expected a whole number .*, got 1e300"),
    (CAR_LINE.replace("2 1.75 10", "2 nan 10"), r"line 1: y: expected a finite number, got 'nan'"),
    (
        CAR_LINE.replace("1.5 1.6 4", "1.5 -1.6 4"),
        r"line 1: h w l: expected a positive size in m, got \[1\.5, -1\.6, 4\.0\]",
    ),
    (f"\n{CAR_LINE}\n{CAR_LINE}", r"line 3: id: expected each track once a frame, 4 is in frame 0 again"),
]


def test_broken_labels(tmp_path, subtests):
    for text, message in BROKEN_LABELS:
        with subtests.test(message), pytest.raises(InputError, match=rf"l\.txt: {message}"):
            read_kitti_labels(write(tmp_path / "l.txt", text))

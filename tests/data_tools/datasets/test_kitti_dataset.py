from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from data_tools.datasets.kitti import KittiTracking
from saga_fg import Dataset, InputError
from tests.data_tools.kitti_example import write_sequence


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_sequence(tmp_path)


def test_scene(root: Path) -> None:
    data: Dataset = KittiTracking(root, root / "found")
    assert data.scenes == ("0007",)
    scene = data.scene("0007")
    np.testing.assert_allclose(scene.timestamps, [0, 0.1, 0.2])
    np.testing.assert_allclose(scene.world_T_ego[:, 0, 3], [0, 1, 2], atol=1e-6)
    assert scene.tokens == ("000000", "000001", "000002")
    assert scene.ground_truth is None


def test_every_moment_has_a_frame(root: Path) -> None:
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


def test_ground_truth(root: Path) -> None:
    truth = KittiTracking(root, ground_truth=True).scene("0007").ground_truth
    assert truth is not None
    assert [moment.id.tolist() for moment in truth] == [["4"], ["4"], ["4", "5"]]
    assert truth[2].boxes.label.tolist() == ["car", "person_sitting"]
    assert [moment.visible.tolist() for moment in truth] == [[True], [True], [False, False]]
    # at rest before a vehicle that does 1 m in 0.1 s, the car does as much
    for moment in truth:
        np.testing.assert_allclose(moment.boxes.velocity[0], [10, 0], atol=1e-4)
    assert np.isnan(truth[2].boxes.velocity[1]).all()


def test_without_detections_there_are_no_frames_and_the_root_may_be_the_training_folder(root: Path) -> None:
    assert len(KittiTracking(root / "training").scene("0007").frames) == 0


def test_class_without_a_file_is_empty_and_said(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    (root / "found" / "Cyclist" / "0007.txt").unlink()
    with caplog.at_level(logging.WARNING):
        frames = KittiTracking(root, root / "found").scene("0007").frames
    assert [len(frame) for frame in frames] == [1, 0, 1]
    assert len(caplog.records) == 1


def test_unknown_sequence_suggests_the_nearest(root: Path) -> None:
    with pytest.raises(InputError, match="unknown sequence '0070'; did you mean '0007'"):
        KittiTracking(root, sequences=["0070"])
    with pytest.raises(InputError, match="unknown sequence '0001'"):
        KittiTracking(root).scene("0001")


def test_missing_files_and_folders(root: Path) -> None:
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


def test_broken_detections(root: Path, subtests: pytest.Subtests) -> None:
    for text, message in BROKEN_DETECTIONS:
        with subtests.test(message):
            (root / "found" / "Car" / "0007.txt").write_text(text)
            with pytest.raises(InputError, match=rf"Car/0007\.txt: {message}"):
                KittiTracking(root, root / "found").scene("0007")


def test_label_beyond_the_last_frame(root: Path) -> None:
    path = root / "training" / "label_02" / "0007.txt"
    path.write_text(path.read_text().replace("2 5 Person", "7 5 Person"))
    with pytest.raises(InputError, match=r"label_02/0007\.txt: frame 7: expected frames 0 to 2 only"):
        KittiTracking(root, ground_truth=True).scene("0007")

"""The reader and writer on real recordings, where there are some."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from data_tools.datasets.kitti import KittiTracking, image_boxes, observation_angles, read_kitti_labels
from data_tools.kitti_objects import camera_boxes_to_world, has_box, world_boxes_to_camera
from saga_fg.numerics.geometry import inverse_transform


@pytest.fixture(scope="module")
def kitti(recordings: Path) -> KittiTracking:
    return KittiTracking(recordings / "kitti", recordings / "kitti" / "detections" / "pointrcnn", ground_truth=True)


def lines(path: Path) -> int:
    return len(path.read_text().splitlines())


def test_every_record_is_read(kitti: KittiTracking, recordings: Path) -> None:
    for name in kitti.scenes:
        scene = kitti.scene(name)
        assert len(scene) == len(scene.frames) == lines(recordings / "kitti" / "training" / "oxts" / f"{name}.txt")
        found = (recordings / "kitti" / "detections" / "pointrcnn").glob(f"*/{name}.txt")
        assert sum(map(len, scene.frames)) == sum(map(lines, found))


@pytest.mark.parametrize("name", ["0000", "0009"])
def test_labels_to_the_world_and_back(kitti: KittiTracking, recordings: Path, name: str) -> None:
    objects = read_kitti_labels(recordings / "kitti" / "training" / "label_02" / f"{name}.txt")
    objects = objects.select(has_box(objects))
    calibration = kitti.calibration(name)
    world_T_camera = kitti.scene(name).world_T_ego[objects.frame] @ inverse_transform(calibration.camera_T_imu)
    back = world_boxes_to_camera(camera_boxes_to_world(objects.boxes, objects.type, world_T_camera), world_T_camera)
    np.testing.assert_allclose(back.size, objects.boxes.size, rtol=0, atol=1e-9)
    np.testing.assert_allclose(back.location, objects.boxes.location, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.cos(back.rotation_y - objects.boxes.rotation_y), 1, rtol=0, atol=1e-12)


def test_projection_agrees_with_the_labelled_image_boxes(kitti: KittiTracking, recordings: Path) -> None:
    objects = read_kitti_labels(recordings / "kitti" / "training" / "label_02" / "0000.txt")
    objects = objects.select(has_box(objects) & (objects.truncated == 0))
    drawn = image_boxes(objects.boxes, kitti.calibration("0000").projection, (1242, 375))
    assert np.median(np.abs(drawn - objects.bbox)) < 2  # pixels
    apart = observation_angles(objects.boxes) - objects.alpha
    assert np.median(np.abs(np.angle(np.exp(1j * apart)))) < 0.01


def test_parked_cars_stay_put_in_the_world_and_moving_ones_move_as_they_head(kitti: KittiTracking) -> None:
    scene = kitti.scene("0009")  # the vehicle drives 400 m
    assert scene.ground_truth is not None
    rows = np.concatenate(
        [
            np.column_stack([moment.id.astype(int), b.position[:, :2], b.velocity, b.yaw])[b.label == "car"]
            for moment in scene.ground_truth
            for b in [moment.boxes]
        ]
    )
    speed = np.hypot(rows[:, 3], rows[:, 4])
    cars = [rows[:, 0] == i for i in np.unique(rows[:, 0])]
    parked = [m for m in cars if m.sum() > 20 and np.nanmedian(speed[m]) < 0.7]
    assert len(parked) > 20
    assert np.median([rows[m, 1:3].std(axis=0).max() for m in parked]) < 0.2
    fast = speed > 5
    heading = np.cos(np.arctan2(rows[fast, 4], rows[fast, 3]) - rows[fast, 5])
    assert np.median(heading) > 0.99


def test_detections_lie_on_the_labels(kitti: KittiTracking) -> None:
    scene = kitti.scene("0011")
    assert scene.ground_truth is not None
    nearest = []
    for frame, truth in zip(scene.frames, scene.ground_truth, strict=True):
        found = frame.detections.boxes.position[frame.detections.boxes.label == "car"]
        seen = truth.boxes.position[truth.visible & (truth.boxes.label == "car")]
        if len(found) and len(seen):
            apart = np.linalg.norm(seen[:, None] - found[None], axis=-1).min(axis=1)
            nearest += apart[apart < 2].tolist()
    assert np.median(nearest) < 0.2


def test_results_of_another_tracker_are_read(recordings: Path) -> None:
    for path in (recordings / "golden" / "kitti_3dmot" / "results").glob("*.txt"):
        objects = read_kitti_labels(path)
        assert len(objects) == lines(path)
        assert np.isfinite(objects.score).all()

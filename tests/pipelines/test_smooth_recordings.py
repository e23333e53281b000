"""Labels of recordings are nearer to the truth than the online tracks, in every class, on the boxes that both have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from data_tools.datasets.kitti import KittiTracking
from data_tools.datasets.nuscenes import NuScenes
from data_tools.metrics import SceneBoxes
from data_tools.metrics.labels import CommonBoxes, LabelledScene, common_boxes
from pipelines.smoothing import load_smooth_config, smooth_scene
from pipelines.tracking import track_scene
from saga_fg.types.dataset import Dataset, Scene

SCENES = {"nuscenes": ("scene-0061", "scene-0553", "scene-1094"), "kitti": ("0000", "0011", "0017")}
FEWEST = 30  # boxes of a class that is compared


def dataset_of(family: str, recordings: Path) -> Dataset:
    root = recordings / family
    if family == "kitti":
        return KittiTracking(root, root / "detections" / "pointrcnn", SCENES[family], ground_truth=True)
    found = {"lidar": root / "detections" / "megvii_lidar.json"}
    return NuScenes(root, "v1.0-mini", found, SCENES[family], ground_truth=True)


def compared(scene: Scene, family: str) -> CommonBoxes:
    """The true boxes that both match within 2 m."""
    config = load_smooth_config(family)
    systems = {
        "online": SceneBoxes.of_tracks(track_scene(scene, config.tracking.new_tracker("saga")).tracks),
        "labels": SceneBoxes.of_tracks(smooth_scene(scene, config).tracks),
    }
    assert scene.ground_truth is not None
    truth = SceneBoxes.of_annotations(scene.ground_truth)
    visible = np.concatenate([moment.visible for moment in scene.ground_truth])
    return common_boxes(LabelledScene(truth, visible, truth.boxes.velocity, np.zeros(len(truth)), systems), gate=2.0)


@pytest.mark.parametrize("family", list(SCENES))
def test_labels_are_nearer_than_online_tracks_in_every_class(recordings: Path, family: str) -> None:
    dataset = dataset_of(family, recordings)
    boxes = CommonBoxes.concatenate([compared(dataset.scene(name), family) for name in dataset.scenes])
    names, count = np.unique(boxes.label, return_counts=True)
    classes = names[count >= FEWEST].tolist()
    assert len(classes) >= 3
    for label in classes:
        of_class = boxes.select(boxes.label == label)
        assert of_class.sample("labels", "position").rmse < of_class.sample("online", "position").rmse, label

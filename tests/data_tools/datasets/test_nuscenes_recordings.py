"""The reader and writer on real recordings, where there are some."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from data_tools.datasets.nuscenes import NuScenes, read_tracking_results, split_scenes, write_tracking_results
from saga_fg import Tracks

VERSION = "v1.0-mini"


@pytest.fixture(scope="module")
def megvii(recordings: Path) -> NuScenes:
    root = recordings / "nuscenes"
    return NuScenes(root, VERSION, {"lidar": root / "detections" / "megvii_lidar.json"}, ground_truth=True)


def test_every_detection_is_read(megvii: NuScenes, recordings: Path) -> None:
    content = json.loads((recordings / "nuscenes" / "detections" / "megvii_lidar.json").read_text())["results"]
    read = {frame.token: len(frame) for name in megvii.scenes for frame in megvii.scene(name).frames}
    assert read == {token: len(boxes) for token, boxes in content.items() if token in read}
    samples = json.loads((recordings / "nuscenes" / VERSION / "sample.json").read_text())
    assert len(read) == len(samples)


def test_official_split_is_present(recordings: Path) -> None:
    assert len(split_scenes(recordings / "nuscenes", VERSION, "mini_train")) == 8
    assert split_scenes(recordings / "nuscenes", VERSION, "mini_val") == ("scene-0103",)


@pytest.mark.parametrize("label", ["car", "pedestrian"])
def test_detections_lie_on_the_annotations(megvii: NuScenes, label: str) -> None:
    nearest = []
    for name in megvii.scenes:
        scene = megvii.scene(name)
        assert scene.ground_truth is not None
        for frame, truth in zip(scene.frames, scene.ground_truth, strict=True):
            found = frame.detections.boxes
            found = found.select(found.label == label)
            seen = truth.boxes.select(truth.visible & (truth.boxes.label == label))
            if len(found) and len(seen):
                apart = np.linalg.norm(seen.position[:, None, :2] - found.position[None, :, :2], axis=-1)
                best = apart.argmin(axis=1)
                near = apart.min(axis=1) < 2
                nearest += apart.min(axis=1)[near].tolist()
                turned = np.cos(seen.yaw - found.yaw[best])[near]
                if label == "car" and len(turned) > 4:
                    assert np.median(turned) > 0.9  # the same sense of heading
    assert np.median(nearest) < 0.25


def test_annotated_speeds_are_those_of_traffic(megvii: NuScenes) -> None:
    speed = []
    for name in megvii.scenes:
        truth = megvii.scene(name).ground_truth
        assert truth is not None
        speed += [np.linalg.norm(moment.boxes.velocity, axis=1) for moment in truth]
    speeds = np.concatenate(speed)
    assert np.isfinite(speeds).mean() > 0.98
    assert np.nanmedian(speeds) < 1  # most stand still
    assert 5 < np.nanpercentile(speeds, 99) < 30


def test_tracks_of_a_scene_survive_the_file(megvii: NuScenes, tmp_path: Path) -> None:
    scene = megvii.scene("scene-0103")
    assert scene.ground_truth is not None
    ids: dict[str, int] = {}
    moments = []
    for time, truth in zip(scene.timestamps.tolist(), scene.ground_truth, strict=True):
        n = len(truth)
        id_ = np.array([ids.setdefault(i, len(ids)) for i in truth.id.tolist()], dtype=np.int64)
        unknown = np.zeros((n, 2, 2))
        moments.append(Tracks(time, id_, truth.boxes, np.ones(n), unknown, unknown, np.zeros(n)))
    write_tracking_results(tmp_path / "out.json", [(scene, moments)], megvii.meta)
    samples = read_tracking_results(tmp_path / "out.json").samples
    assert list(samples) == list(scene.tokens)
    for token, tracks in zip(scene.tokens, moments, strict=True):
        np.testing.assert_allclose(samples[token].boxes.position, tracks.boxes.position, atol=1e-6)
        np.testing.assert_allclose(np.cos(samples[token].boxes.yaw - tracks.boxes.yaw), 1)

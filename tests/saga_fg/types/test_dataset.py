"""Scenes and annotations: times run forwards, columns fit, and what does not is named with its scene."""

import numpy as np
import pytest

from saga_fg import Annotations, Boxes, Detections, Frame, InputError, Scene
from saga_fg.numerics.geometry import yaw_transform


def annotations(ids=("a", "b"), visible=(True, False)):
    return Annotations(np.array(ids), Boxes.of(["car"] * 2, np.zeros((2, 3))), np.array(visible))


def scene(**columns):
    good = {
        "name": "crossing",
        "timestamps": [0.0, 0.5, 1.0],
        "world_T_ego": np.stack([yaw_transform(k) for k in range(3)]),
        "tokens": ("", "", ""),
        "frames": [Frame(t, s, Detections.empty()) for t, s in ((0.0, "lidar"), (0.0, "camera"), (0.7, "lidar"))],
    }
    return Scene(**(good | columns))


def test_a_scene_knows_its_sensors_and_length():
    assert scene().sensors == ("camera", "lidar")
    assert len(scene()) == 3
    assert not scene().timestamps.flags.writeable
    assert scene(ground_truth=[annotations()] * 3).ground_truth is not None


def test_a_scene_without_moments_or_frames():
    empty = scene(timestamps=[], world_T_ego=[], tokens=(), frames=[])
    assert len(empty) == 0
    assert empty.sensors == ()


def test_a_wrong_scene_is_refused(subtests):
    for columns, message in [
        ({"timestamps": [0.0, 0.5, 0.5]}, r"scene crossing: timestamps\[2\]: expected increasing times, time repeats"),
        ({"timestamps": [0.0, 1.0, 0.5]}, r"scene crossing: timestamps\[2\]: .* time runs backwards at 0.500000 s"),
        ({"timestamps": [0.0, np.nan, 1.0]}, r"timestamps\[1\]: expected a finite number, got nan"),
        ({"timestamps": [[0.0, 0.5, 1.0]]}, r"timestamps: expected shape \(any,\)"),
        ({"world_T_ego": np.tile(np.eye(4), (2, 1, 1))}, r"world_T_ego: expected shape \(3, 4, 4\)"),
        ({"world_T_ego": np.tile(2 * np.eye(4), (3, 1, 1))}, r"scene crossing: world_T_ego\[0\]: expected a rigid"),
        ({"tokens": ("",)}, "scene crossing: tokens: expected 3 entries, got 1"),
        ({"ground_truth": []}, "scene crossing: ground_truth: expected 3 entries, got 0"),
        (
            {"frames": [Frame(t, "lidar", Detections.empty()) for t in (0.5, 0.4)]},
            r"scene crossing: frames\[1\]: expected frames in order of time, 0.400000 s comes late",
        ),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            scene(**columns)


def test_annotations_keep_their_columns():
    truth = annotations()
    assert len(truth) == 2
    assert truth.visible.tolist() == [True, False]
    assert len(Annotations(np.array([]), Boxes.empty(), np.array([]))) == 0


def test_wrong_annotations_are_refused(subtests):
    for ids, visible, message in [
        (("a", "a"), (True, True), "id: expected unique object ids"),
        (("a",), (True, True), "id: expected 2 entries, got 1"),
        ((1, 2), (True, True), "id: expected a list of strings"),
        (("a", "b"), (True,), "visible: expected 2 booleans"),
        (("a", "b"), (1, 0), "visible: expected 2 booleans, got int64"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            annotations(ids, visible)

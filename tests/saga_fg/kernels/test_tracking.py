"""Tracking by kernels and by NumPy: the same tracks of random frames, and the same overlaps and labels."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.config import load_config
from saga_fg.kernels.compilation import only_numpy
from saga_fg.numerics.arrays import distinct
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections, Frame
from saga_fg.types.overlap import bev_iou, paired_bev_iou

CLASSES = ("car", "truck", "pedestrian", "bicycle", "construction_vehicle")


def random_frames(seed, frames=12):
    """Objects of several classes that drive, stand, hide and are reported twice, and false detections."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(0, 14))
    label = rng.choice(CLASSES, n)
    heading = rng.uniform(-0.5, 0.5, n)
    speed = np.where(rng.random(n) < 0.4, 0.0, rng.uniform(1, 15, n))
    place, hidden = rng.uniform(-25, 25, (n, 2)), rng.integers(0, frames, n)
    found = []
    for number in range(frames):
        place = place + 0.2 * speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        gone = (number >= hidden) & (number < hidden + 4) | (rng.random(n) < 0.1)
        seen = np.concatenate([np.flatnonzero(~gone), rng.choice(n, n // 5)]) if n else np.empty(0, dtype=np.int64)
        false = int(rng.integers(0, 4))
        labels = np.concatenate([label[seen], rng.choice(CLASSES, false)]).astype(np.str_)
        k = len(labels)
        z = np.zeros((k, 3))
        z[:, :2] = np.concatenate([place[seen], rng.uniform(-25, 25, (false, 2))]) + rng.normal(scale=0.2, size=(k, 2))
        yaw = np.concatenate([heading[seen], rng.uniform(-3, 3, false)])
        yaw[rng.random(k) < 0.1] = np.nan
        velocity = np.where(rng.random((k, 1)) < 0.7, rng.normal(scale=5.0, size=(k, 2)), np.nan)
        boxes = Boxes.of(labels, z, np.tile((4.0, 1.8, 1.6), (k, 1)), yaw, velocity)
        if rng.random() < 0.1:
            boxes = boxes.select(np.empty(0, dtype=np.int64))
        score = rng.uniform(0.05, 0.95, len(boxes))
        found.append(Frame(0.2 * number, "lidar", Detections(boxes, score), np.eye(4)))
    return found


def tracked(frames, config):
    tracker = config.new_tracker("saga")
    return [tracker.step(frame) for frame in frames], tracker


@pytest.mark.parametrize("family", ["nuscenes", "kitti", "traffic"])
@given(st.integers(0, 10_000))
@settings(max_examples=12, deadline=None)
def test_random_frames_give_the_same_tracks(family, seed):
    config, frames = load_config(family), random_frames(seed)
    by_kernels, one = tracked(frames, config)
    with only_numpy():
        by_numpy, other = tracked(frames, config)
    for mine, theirs in zip(by_kernels, by_numpy, strict=True):
        assert mine.id.tolist() == theirs.id.tolist()
        assert mine.boxes.label.tolist() == theirs.boxes.label.tolist()
        np.testing.assert_allclose(mine.boxes.position, theirs.boxes.position, atol=1e-9)
        np.testing.assert_allclose(mine.boxes.velocity, theirs.boxes.velocity, atol=1e-8)
        np.testing.assert_allclose(mine.score, theirs.score, atol=1e-9)
    assert one.snapshot().table.id.tolist() == other.snapshot().table.id.tolist()


@given(st.integers(0, 10_000))
@settings(max_examples=60, deadline=None)
def test_overlaps_of_boxes(seed):
    rng, n = np.random.default_rng(seed), 12
    sets = []
    for _ in range(2):
        size, yaw = rng.uniform(0.3, 6.0, (n, 3)), rng.choice([0.0, 0.5, np.pi / 2, 3.0, np.nan], n)
        size[rng.random(n) < 0.1] = np.nan
        place = rng.choice([0.0, 1.0, 2.5], (n, 3)) + rng.choice([0.0, 1.0]) * rng.normal(size=(n, 3))
        sets.append(Boxes.of(["car"] * n, place, size, yaw))
    by_kernel, every = paired_bev_iou(*sets), bev_iou(*sets)
    with only_numpy():
        np.testing.assert_allclose(by_kernel, paired_bev_iou(*sets), atol=1e-12)
        np.testing.assert_allclose(every, bev_iou(*sets), atol=1e-12)
    assert paired_bev_iou(Boxes.empty(), Boxes.empty()).shape == (0,)


@given(st.lists(st.sampled_from(["car", "cart", "ca", "bus", "Fußgänger", "construction_vehicle"])), st.booleans())
@settings(deadline=None)
def test_labels_by_number(labels, frozen):
    array = np.array(labels, dtype=np.str_)
    array.flags.writeable = not frozen
    names, number = distinct(array)
    assert names == tuple(dict.fromkeys(labels))
    assert [names[k] for k in number] == labels
    with only_numpy():
        plain = np.array(labels, dtype=np.str_)
        assert distinct(plain)[0] == names
        assert distinct(plain)[1].tolist() == number.tolist()


def test_labels_that_are_changed_are_looked_at_again():
    label = np.array(["car", "bus"])
    assert distinct(label)[0] == ("car", "bus")
    label[0] = "bus"
    assert distinct(label)[0] == ("bus",)

"""Random frames for tests of kernels; overlaps of boxes and numbers of labels."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from saga_fg.numerics.arrays import distinct
from saga_fg.types.boxes import Boxes, bev_iou, paired_bev_iou
from saga_fg.types.frame import Detections, Frame

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


def test_overlaps_of_boxes_that_are_known_by_hand():
    size = np.tile((4.0, 2.0, 1.5), (5, 1))
    place = np.array([(0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, 0.0, 0.0), (9.0, 0.0, 0.0), (0.0, 0.0, 0.0)])
    others = Boxes.of(["car"] * 5, place, size, np.array([0.0, 0.0, np.pi / 2, 0.0, np.nan]))
    one = Boxes.of(["car"] * 5, np.zeros((5, 3)), size, np.zeros(5))
    expected = [1.0, 1 / 3, 4 / 12, 0.0, np.nan]
    np.testing.assert_allclose(paired_bev_iou(one, others), expected, atol=1e-9)
    np.testing.assert_allclose(np.diagonal(bev_iou(one, others))[:4], expected[:4], atol=1e-9)
    assert paired_bev_iou(Boxes.empty(), Boxes.empty()).shape == (0,)


@given(st.lists(st.sampled_from(["car", "cart", "ca", "bus", "Fußgänger", "construction_vehicle"])), st.booleans())
@settings(deadline=None)
def test_labels_by_number(labels, frozen):
    array = np.array(labels, dtype=np.str_)
    array.flags.writeable = not frozen
    names, number = distinct(array)
    assert names == tuple(dict.fromkeys(labels))
    assert [names[k] for k in number] == labels


def test_labels_that_are_changed_are_looked_at_again():
    label = np.array(["car", "bus"])
    assert distinct(label)[0] == ("car", "bus")
    label[0] = "bus"
    assert distinct(label)[0] == ("bus",)

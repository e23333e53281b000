"""Duplicates: of two detections too close to be two objects the weaker goes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg import Boxes
from saga_fg.tracking.measurements import suppress_duplicates, suppress_other_classes


def kept(x, probability, distance=1.0, label="car", shadow=0.0, ratio=0.5):
    n = len(x)
    boxes = Boxes.of(np.broadcast_to(label, n), np.stack([x, np.zeros(n), np.zeros(n)], axis=-1))
    distances = (np.broadcast_to(d, n).astype(float) for d in (distance, shadow, ratio))
    return suppress_duplicates(boxes, np.asarray(probability), *distances).tolist()


def test_the_weaker_of_two_goes():
    assert kept([0.0, 0.5, 5.0], [0.4, 0.9, 0.1]) == [1, 2]
    assert kept([0.0, 0.5], [0.9, 0.9]) == [0]


def test_what_is_suppressed_suppresses_nothing():
    assert kept([0.0, 0.8, 1.6], [0.9, 0.8, 0.7]) == [0, 2]
    assert kept([0.0, 0.8, 1.6], [0.7, 0.9, 0.8]) == [1]


def test_classes_do_not_suppress_each_other():
    assert kept([0.0, 0.1], [0.9, 0.8], label=["car", "pedestrian"]) == [0, 1]


def test_distance_zero_suppresses_nothing():
    assert kept([0.0, 0.0], [0.9, 0.8], distance=0.0) == [0, 1]
    assert kept([0.0, 0.5], [0.9, 0.8], distance=0.5) == [0, 1]


def test_a_much_weaker_detection_close_by_is_a_shadow():
    assert kept([0.0, 1.5, 9.0], [0.9, 0.4, 0.1], shadow=2.0) == [0, 2]
    assert kept([0.0, 1.5], [0.9, 0.5], shadow=2.0) == [0, 1], "as strong as a second object"
    assert kept([0.0, 2.5], [0.9, 0.4], shadow=2.0) == [0, 1], "too far away"
    assert kept([0.0, 0.5], [0.9, 0.8], shadow=2.0) == [0], "a duplicate all the same"


@pytest.mark.parametrize("n", [0, 1])
def test_few_boxes(n):
    assert kept(np.zeros(n), np.ones(n)) == list(range(n))


@given(st.integers(0, 2**32 - 1), st.integers(2, 12))
def test_what_stays_is_apart_and_what_goes_was_beaten(seed, n):
    rng = np.random.default_rng(seed)
    position = rng.uniform(0, 4, (n, 3))
    probability = rng.permutation(n) / n
    label = rng.choice(["car", "bus"], n)
    distance = np.where(label == "car", 1.0, 1.5)
    stays = suppress_duplicates(Boxes.of(label, position), probability, distance, np.zeros(n), np.ones(n))
    apart = np.hypot(*np.moveaxis(position[:, None, :2] - position[None, :, :2], -1, 0))
    rival = (label[:, None] == label) & (apart < distance[:, None]) & ~np.eye(n, dtype=bool)
    assert (np.diff(stays) > 0).all()
    assert not rival[np.ix_(stays, stays)].any()
    for k in np.setdiff1d(np.arange(n), stays):
        assert (rival[k, stays] & (probability[stays] > probability[k])).any()


def of_one_class_kept(x, probability, label, overlap):
    n = len(x)
    boxes = Boxes.of(label, np.stack([x, np.zeros(n), np.zeros(n)], axis=-1), [[4.0, 2.0, 1.5]] * n, np.zeros(n))
    return suppress_other_classes(boxes, np.asarray(probability), np.full(n, overlap)).tolist()


def test_of_two_classes_in_one_place_the_less_probable_goes():
    assert of_one_class_kept([0.0, 0.4], [0.4, 0.9], ["truck", "car"], 0.5) == [1]
    assert of_one_class_kept([0.0, 0.4], [0.4, 0.9], ["truck", "car"], 0.9) == [0, 1], "IoU 3.6 / 4.4 is less"
    assert of_one_class_kept([0.0, 0.4], [0.4, 0.9], ["truck", "car"], 1.0) == [0, 1], "1 is never"


def test_within_a_class_overlap_says_nothing():
    assert of_one_class_kept([0.0, 0.4], [0.4, 0.9], ["car", "car"], 0.1) == [0, 1]


def test_one_that_was_driven_out_drives_out_nothing():
    # 0 and 2 are too far apart; 1, between them, gives way to 0 and no longer counts
    assert of_one_class_kept([0.0, 1.5, 3.0], [0.9, 0.8, 0.7], ["car", "truck", "bus"], 0.3) == [0, 2]


def test_a_box_of_unknown_size_stays():
    boxes = Boxes.of(["car", "truck"], np.zeros((2, 3)))
    assert suppress_other_classes(boxes, np.array([0.9, 0.1]), np.full(2, 0.1)).tolist() == [0, 1]

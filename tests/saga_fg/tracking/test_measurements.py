"""Duplicates: of two detections too close to be two objects the weaker goes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg import Boxes
from saga_fg.numerics.arrays import common_numbers
from saga_fg.tracking.measurements import suppress_duplicates


def kept(x, probability, distance=1.0, label="car", shadow=0.0):
    n = len(x)
    boxes = Boxes.of(np.broadcast_to(label, n), np.stack([x, np.zeros(n), np.zeros(n)], axis=-1))
    near, wide = (np.broadcast_to(d, n).astype(float) for d in (distance, shadow))
    (group,) = common_numbers(boxes.label)
    into = suppress_duplicates(boxes, np.asarray(probability), near, wide, group)
    assert (into[into] == into).all()
    return np.flatnonzero(into == np.arange(n)).tolist()


@pytest.mark.parametrize(
    ("x", "probability", "options", "expected"),
    [
        ([], [], {}, []),
        ([0.0], [1.0], {}, [0]),
        ([0.0, 0.5, 5.0], [0.4, 0.9, 0.1], {}, [1, 2]),
        ([0.0, 0.5], [0.9, 0.9], {}, [0]),
        ([0.0, 0.8, 1.6], [0.9, 0.8, 0.7], {}, [0, 2]),  # what is suppressed suppresses nothing
        ([0.0, 0.8, 1.6], [0.7, 0.9, 0.8], {}, [1]),
        ([0.0, 0.1], [0.9, 0.8], {"label": ["car", "pedestrian"]}, [0, 1]),
        ([0.0, 0.0], [0.9, 0.8], {"distance": 0.0}, [0, 1]),
        ([0.0, 0.5], [0.9, 0.8], {"distance": 0.5}, [0, 1]),
        ([0.0, 1.5, 9.0], [0.9, 0.4, 0.1], {"shadow": 2.0}, [0, 2]),
        ([0.0, 1.5], [0.9, 0.5], {"shadow": 2.0}, [0, 1]),  # as strong as a second object
        ([0.0, 2.5], [0.9, 0.4], {"shadow": 2.0}, [0, 1]),
        ([0.0, 0.5], [0.9, 0.8], {"shadow": 2.0}, [0]),
    ],
)
def test_the_weaker_of_two_goes(x, probability, options, expected):
    assert kept(x, probability, **options) == expected


@given(st.integers(0, 2**32 - 1), st.integers(2, 12))
def test_what_stays_is_apart_and_what_goes_was_beaten(seed, n):
    rng = np.random.default_rng(seed)
    position = rng.uniform(0, 4, (n, 3))
    probability = rng.permutation(n) / n
    label = rng.choice(["car", "bus"], n)
    distance = np.where(label == "car", 1.0, 1.5)
    (group,) = common_numbers(label)
    into = suppress_duplicates(Boxes.of(label, position), probability, distance, np.zeros(n), group)
    stays = np.flatnonzero(into == np.arange(n))
    apart = np.hypot(*np.moveaxis(position[:, None, :2] - position[None, :, :2], -1, 0))
    rival = (label[:, None] == label) & (apart < distance[:, None]) & ~np.eye(n, dtype=bool)
    assert (np.diff(stays) > 0).all()
    assert not rival[np.ix_(stays, stays)].any()
    for k in np.setdiff1d(np.arange(n), stays):
        assert rival[k, into[k]]
        assert probability[into[k]] > probability[k]

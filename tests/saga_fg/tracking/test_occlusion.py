"""Occlusion of boxes by others."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg import Boxes, Tracker, TrackerSettings
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.tracking import ExistenceSettings
from saga_fg.tracking.existence import covered
from tests.saga_fg.traffic_frames import NAN, SIZE, frame

ALL = np.array([True, True])
EGO = yaw_transform(0.0, 0.0, 0.0, 0.0)


def two(first, second, size=(1.0, 4.0, 1.5), yaw=0.0):
    n = len(first) - 1
    position = np.array([[*first, 0.0], [*second, 0.0]])
    return Boxes.of(np.array(["car"] * 2), position, np.tile(size, (2, 1)), np.full(2, yaw)) if n else None


def test_the_farther_of_two_in_a_row_is_hidden():
    assert covered(two((10, 0), (20, 0)), np.zeros(2), ALL) == pytest.approx([0.0, 1.0])


def test_half_a_box_is_half_hidden():
    """Two thin walls across the line of sight; the near one covers bearings from 0 up."""
    share = covered(two((10.0, 2.0), (20.0, 0.0), size=(0.01, 4.0, 1.5)), np.zeros(2), ALL)
    assert share == pytest.approx([0.0, 0.5], abs=0.01)


@pytest.mark.parametrize(
    ("boxes", "opaque"),
    [
        (two((10, 0), (20, 15)), ALL),
        (two((10, 0), (-20, 0)), ALL),
        (two((10, 0), (11, 0)), ALL),
        (two((10, 0), (20, 0)), np.array([False, True])),
        (two((10, 0), (20, 0), yaw=NAN), ALL),
    ],
    ids=["aside", "behind the sensor", "one inside the other", "not there", "unknown heading"],
)
def test_what_is_not_hidden(boxes, opaque):
    assert covered(boxes, np.zeros(2), opaque) == pytest.approx([0.0, 0.0])


@given(turn=st.floats(-3, 3), x=st.floats(-50, 50), y=st.floats(-50, 50))
def test_the_world_may_be_turned_and_moved(turn, x, y):
    boxes, move = two((10.0, 2.0), (20.0, 0.0)), yaw_transform(x, y, 0.0, turn)
    expected = covered(boxes, np.zeros(2), ALL)
    assert 0.1 < expected[1] < 1
    assert covered(boxes.transformed(move), move[:2, 3], ALL) == pytest.approx(expected, abs=1e-6)


def existence(occlusion):
    """Existence of a car once another hides it, and the number of its misses."""
    settings = TrackerSettings(edges=(), existence=ExistenceSettings(occlusion_weight=occlusion, lifetime=np.inf))
    tracker = Tracker(settings)
    for k in range(15):
        cars = [(20.0, 0.0)] if k < 10 else [(10.0, 0.0)]
        tracker.step(replace(frame(0.1 * k, cars, size=SIZE, yaw=np.pi / 2), world_T_ego=EGO))
    table = tracker.snapshot().table
    return table.existence[0], table.opportunities[0] - table.hits[0]


def test_a_hidden_track_is_not_believed_in_less():
    kept, misses = existence(1.0)
    lost, in_vain = existence(0.0)
    assert kept > 0.98
    assert lost < 0.6
    assert (misses, in_vain) == (1, 5), "in the first frame, the car in front is no track yet"

"""Visibility: what nearer boxes cover, the chain of hidden and in view, and what that makes of a track."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from saga_fg import Tracker, TrackerSettings
from saga_fg.model.sensor import FieldOfView, Sensor
from saga_fg.tracking import ClassSettings
from saga_fg.tracking.track_table import MEMORY, SensorEvidence
from saga_fg.tracking.update import visible_share
from saga_fg.types.boxes import Boxes
from tests.saga_fg.traffic_frames import frame, run

# Visible shares on cases one can work out by hand

EYE = np.array([0.0, 0.0, 2.0])


def box(x: float, y: float, length: float = 4.0, width: float = 2.0, height: float = 1.5, yaw: float = 0.0) -> Boxes:
    return Boxes.of(["car"], [[x, y, height / 2]], [[length, width, height]], [yaw], [[0.0, 0.0]])


def share(*boxes: Boxes, rays: int = 400) -> float:
    """Visible share of the first box, seen past the others."""
    return float(visible_share(EYE, Boxes.concatenate(boxes), np.array([0]), rays)[0])


def test_what_is_seen_is_what_nothing_before_it_hides_half_or_whole():
    assert share(box(20, 3)) == 1.0
    assert visible_share(EYE, box(20, 3), np.empty(0, dtype=np.int64)).shape == (0,)
    assert share(box(20, 0), box(30, 0, height=4.0), box(20, 3, height=4.0), box(-10, 0, height=4.0)) == 1.0
    assert share(box(20, 0), box(10, 0, length=0.5, width=4.0, height=3.0)) == 0.0
    thin = box(20, 0, length=0.01, width=2.0)  # fills the azimuths of -1 m to 1 m at 20 m
    wall = box(10, 5.0, length=0.01, width=10.0, height=3.0)  # from 0 m to the left
    assert share(thin, wall) == pytest.approx(0.5, abs=0.01)
    quarter = box(10, 5.25, length=0.01, width=10.0, height=3.0)  # from 0.25 m, which at 20 m is 0.5 m
    assert share(thin, quarter) == share(thin, quarter, quarter) == pytest.approx(0.75, abs=0.01)
    right = box(10, -5.25, length=0.01, width=10.0, height=3.0)
    assert share(thin, quarter, right) == pytest.approx(0.5, abs=0.01)


def test_occluders_throw_shadows_by_their_height_and_place():
    """An eye 2 m up sees the ground at 20 m past an edge 1 m high at 10 m: half of 1 m is hidden at 15 m."""
    low = box(10, 0, length=0.01, width=6.0, height=1.0)
    assert share(box(15, 0, length=0.01, height=1.0), low) == pytest.approx(0.5, abs=0.01)
    assert share(box(19.9, 0, length=0.01, height=1.0), low) == pytest.approx(0.99, abs=0.01)
    assert share(box(10.1, 0, length=0.01, height=1.0), low) == pytest.approx(0.01, abs=0.01)
    assert share(box(40, 0, length=0.01, height=1.0), low) == 1.0
    high = box(10, 0, length=0.01, width=20.0, height=2.01)
    assert share(box(60, 0, height=1.5), high) == 0.0
    assert share(box(60, 0, height=4.0), high) == pytest.approx((4.0 - (2 + 0.01 * 58 / 10)) / 4.0, abs=0.01)
    truck = box(0, 2.0, length=12.0, width=2.5, height=3.5)
    assert share(box(0, 8), truck) == 0.0
    assert share(box(15, 6), truck) == 0.0
    assert share(box(0, -8), truck) == 1.0
    assert share(truck, box(0, 8)) == 1.0
    again = box(0, 1.8, length=12.0, width=2.5, height=5.0)
    twice, rows = Boxes.concatenate([truck, again]), np.array([0])  # a second box of one object does not hide the first
    assert visible_share(EYE, twice, rows, solid=np.ones(2, dtype=bool)) == pytest.approx([1.0], abs=0.01)


@settings(max_examples=50, deadline=None)
@given(turn=st.floats(-np.pi, np.pi), seed=st.integers(0, 1000))
def test_turning_the_whole_world_changes_nothing_and_more_boxes_hide_more(turn, seed):
    rng = np.random.default_rng(seed)
    n = 10
    places = rng.uniform(-40, 40, (n, 2))
    places += 4.0 * np.sign(places)
    boxes = Boxes.of(
        ["car"] * n,
        np.column_stack([places, np.full(n, 0.75)]),
        np.column_stack([rng.uniform(2, 10, n), rng.uniform(1, 3, n), rng.uniform(1, 4, n)]),
        rng.uniform(-3, 3, n),
        np.zeros((n, 2)),
    )
    c, s = np.cos(turn), np.sin(turn)
    turned = boxes.transformed(np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))
    rows = np.arange(n)
    shares = visible_share(EYE, boxes, rows, 100)
    assert ((shares >= 0) & (shares <= 1)).all()
    assert visible_share(EYE, turned, rows, 100) == pytest.approx(shares, abs=0.03)
    fewer = visible_share(EYE, boxes.select(rows[:-2]), rows[:-2], 100)
    assert (fewer >= shares[:-2] - 1e-9).all()


def test_boxes_of_unknown_size_are_visible_and_hide_nothing_and_so_do_those_that_are_not_solid():
    unknown = box(20, 0, length=np.nan)
    assert share(unknown, box(10, 0, width=6.0, height=3.0)) == 1.0
    assert share(box(30, 0), unknown) == 1.0
    both, rows = Boxes.concatenate([box(30, 0), box(10, 0, width=6.0, height=3.0)]), np.array([0])
    assert visible_share(EYE, both, rows, solid=np.array([True, True])).tolist() == [0.0]
    assert visible_share(EYE, both, rows, solid=np.array([True, False])).tolist() == [1.0]


# The chain of two states

NONE = np.empty(0, dtype=np.int64)


@settings(max_examples=50)
@given(
    chance=st.floats(0.05, 0.99), view=st.lists(st.floats(0.3, 1.0), min_size=1, max_size=6), step=st.floats(0.05, 2.0)
)
def test_visibility_is_the_posterior_of_a_markov_chain(chance, view, step):
    """Missed frame after frame: forward algorithm over hidden and in view, which is forgotten over MEMORY."""
    evidence = SensorEvidence.empty().initiated("lidar", np.array([0.6]), 0.0)
    posterior, kept = np.array([0.0, 1.0]), np.exp(-step / MEMORY)
    for k, share in enumerate(view, start=1):
        evidence.look("lidar", np.array([share]), k * step)
        evidence.update("lidar", k * step, NONE, np.empty(0), np.array([True]), np.array([chance]))
        prior = kept * posterior + (1 - kept) * np.array([1 - share, share])
        posterior = prior * np.array([1.0, 1 - chance])
        posterior /= posterior.sum()
        assert evidence.seen_by("lidar") == pytest.approx(posterior[1])
    evidence.update("lidar", 9.0, np.array([0]), np.array([0.6]), np.array([False]), np.array([chance]))
    assert evidence.seen_by("lidar").tolist() == [1.0]


def test_the_field_of_view_is_not_remembered_and_a_silent_sensor_keeps_its_own():
    evidence = SensorEvidence.empty().initiated("lidar", np.array([0.6, 0.6]), 0.0)
    evidence.look("camera", np.array([1.0, 0.0]), 0.0)
    evidence.look("lidar", np.array([0.0, 0.9]), 0.1)
    assert evidence.seen_by("lidar")[0] == 0.0
    assert evidence.seen_by_any()[0] == 1.0
    evidence.look("camera", np.array([0.0, 0.8]), 0.1)
    assert evidence.seen_by("camera").tolist() == [0.0, 0.8]
    assert evidence.seen_by_any()[0] == 0.0


# What it makes of a track

PATIENT = TrackerSettings({"default": ClassSettings(max_deviation=np.inf)})


def missed(van, frames=6, **pose):
    """Existence and reported scores of a car at 30 m that is missed `frames` times after ten detections, where
    something of this size (length, width, height) stands before it, at 15 m."""
    tracker, pose = Tracker(PATIENT), {"world_T_ego": np.eye(4), **pose}
    for k in range(10):
        tracker.step(frame(k / 10, [(30.0, 0.0), (15.0, 0.0)], size=[(4.5, 1.9, 1.6), van], yaw=0.0, **pose))
    gap = [frame(1.0 + k / 10, [(15.0, 0.0)], size=van, **pose) for k in range(frames)]
    scores = [float(tracks.score[0]) for tracks in run(tracker, gap)]
    return float(tracker.snapshot().table.existence[0]), scores


def test_existence_falls_only_where_the_object_should_have_been_seen():
    hidden, in_view = missed((6.0, 3.0, 3.0)), missed((1.0, 0.3, 0.5))
    assert hidden[0] > 0.8 > 0.01 > in_view[0]
    assert in_view[1][-1] < 0.01
    assert hidden[1][-1] < hidden[1][0]
    without_pose = missed((6.0, 3.0, 3.0), world_T_ego=None)
    assert without_pose[0] == in_view[0]


def test_what_leaves_every_field_of_view_is_kept_but_not_reported():
    ahead = Sensor(field_of_view=FieldOfView(min_azimuth=-0.5, max_azimuth=0.5))
    tracker, pose = Tracker(PATIENT, {"default": ahead}), {"world_T_ego": np.eye(4)}
    for k in range(10):
        tracker.step(frame(k / 10, [(20.0, 9.0 + 0.2 * k), (20.0, -5.0)], **pose))
    gone = run(tracker, [frame(1.0 + k / 10, [(20.0, -5.0)], **pose) for k in range(12)])
    assert [tracks.id.tolist() for tracks in gone][-3:] == [[2]] * 3
    table = tracker.snapshot().table
    assert table.id.tolist() == [1, 2]
    assert table.existence[0] > 0.5
    assert tracker.step(frame(2.2, [(20.0, 13.4), (20.0, -5.0)], **pose)).id.tolist() == [1, 2]

"""Visible shares on cases one can work out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from data_tools.simulator.sensors import visible_share
from saga_fg.types.boxes import Boxes

EYE = np.array([0.0, 0.0, 2.0])


def box(x: float, y: float, length: float = 4.0, width: float = 2.0, height: float = 1.5, yaw: float = 0.0) -> Boxes:
    return Boxes.of(["car"], [[x, y, height / 2]], [[length, width, height]], [yaw], [[0.0, 0.0]])


def share(*boxes: Boxes, rays: int = 400) -> float:
    """Visible share of the first box, seen past the others."""
    return float(visible_share(EYE, Boxes.concatenate(boxes), np.array([0]), rays)[0])


def test_alone_an_object_is_seen_whole() -> None:
    assert share(box(20, 3)) == 1.0
    assert visible_share(EYE, box(20, 3), np.empty(0, dtype=np.int64)).shape == (0,)


def test_what_stands_behind_or_beside_hides_nothing() -> None:
    assert share(box(20, 0), box(30, 0, height=4.0), box(20, 3, height=4.0), box(-10, 0, height=4.0)) == 1.0


def test_a_wall_as_wide_as_the_view_hides_everything() -> None:
    assert share(box(20, 0), box(10, 0, length=0.5, width=4.0, height=3.0)) == 0.0


def test_half_of_the_azimuth_behind_a_wall_is_half_the_object() -> None:
    thin = box(20, 0, length=0.01, width=2.0)  # fills the azimuths of -1 m to 1 m at 20 m
    wall = box(10, 5.0, length=0.01, width=10.0, height=3.0)  # from 0 m to the left
    assert share(thin, wall) == pytest.approx(0.5, abs=0.01)
    quarter = box(10, 5.25, length=0.01, width=10.0, height=3.0)  # from 0.25 m, which at 20 m is 0.5 m
    assert share(thin, quarter) == share(thin, quarter, quarter) == pytest.approx(0.75, abs=0.01)
    right = box(10, -5.25, length=0.01, width=10.0, height=3.0)
    assert share(thin, quarter, right) == pytest.approx(0.5, abs=0.01)


def test_a_low_occluder_throws_a_shadow_that_falls_with_range() -> None:
    """An eye 2 m up sees the ground at 20 m past an edge 1 m high at 10 m: half of 1 m is hidden at 15 m."""
    low = box(10, 0, length=0.01, width=6.0, height=1.0)
    assert share(box(15, 0, length=0.01, height=1.0), low) == pytest.approx(0.5, abs=0.01)
    assert share(box(19.9, 0, length=0.01, height=1.0), low) == pytest.approx(0.99, abs=0.01)
    assert share(box(10.1, 0, length=0.01, height=1.0), low) == pytest.approx(0.01, abs=0.01)
    assert share(box(40, 0, length=0.01, height=1.0), low) == 1.0


def test_an_occluder_higher_than_the_sensor_throws_an_endless_shadow() -> None:
    high = box(10, 0, length=0.01, width=20.0, height=2.01)
    assert share(box(60, 0, height=1.5), high) == 0.0
    assert share(box(60, 0, height=4.0), high) == pytest.approx((4.0 - (2 + 0.01 * 58 / 10)) / 4.0, abs=0.01)


def test_an_object_beside_the_sensor_hides_half_the_world() -> None:
    truck = box(0, 2.0, length=12.0, width=2.5, height=3.5)
    assert share(box(0, 8), truck) == 0.0
    assert share(box(15, 6), truck) == 0.0
    assert share(box(0, -8), truck) == 1.0
    assert share(truck, box(0, 8)) == 1.0


@settings(max_examples=50, deadline=None)
@given(turn=st.floats(-np.pi, np.pi), seed=st.integers(0, 1000))
def test_turning_the_whole_world_changes_nothing_and_more_boxes_hide_more(turn: float, seed: int) -> None:
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

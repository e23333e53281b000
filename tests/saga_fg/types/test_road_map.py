"""Lanes across stop lines, and feet on many polylines at once."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from saga_fg.numerics.geometry import Polylines, direction_at, feet
from saga_fg.types.road_map import Lane, LanesAcross, StopLine

STRAIGHT = Lane("straight", ((-50.0, 0.0), (20.0, 0.0)), width=4.0)
ASIDE = Lane("aside", ((-50.0, 3.0), (0.0, 3.0), (20.0, 5.0)), width=4.0)
BACK = Lane("back", ((20.0, 0.0), (-50.0, 0.0)))
LINE = StopLine("line", (0.0, 5.0), (0.0, -2.0), "light")
FAR = StopLine("far", (200.0, 2.0), (200.0, -2.0), "light")
NOWHERE = StopLine("nowhere", (0.0, 90.0), (0.0, 86.0), "light")


def test_feet_on_many_polylines_are_those_on_each():
    rng = np.random.default_rng(0)
    lines = [np.cumsum(rng.uniform(0.5, 3.0, (k, 2)), axis=0) for k in (2, 7, 3)]
    places = rng.uniform(-3, 15, (60, 2))
    line = rng.integers(0, 3, 60)
    found = Polylines.from_points(lines).feet(line, places)
    for k, each in enumerate(lines):
        mine = line == k
        for column, alone in zip(found, feet(each, places[mine]), strict=True):
            np.testing.assert_allclose(column[mine], alone, atol=1e-12)
        brute = min_distance(each, places[mine])
        inside = (found.s[mine] > 0) & (found.s[mine] < np.hypot(*np.diff(each, axis=0).T).sum())
        np.testing.assert_allclose(np.hypot(*(found.point - places)[mine].T)[inside], brute[inside], atol=2e-3)


def min_distance(line: np.ndarray, places: np.ndarray) -> np.ndarray:
    s = np.linspace(0, 1, 2000)[:, None]
    points = np.concatenate([a + s * (b - a) for a, b in itertools.pairwise(line)])
    return np.hypot(*np.moveaxis(places[:, None] - points, -1, 0)).min(axis=1)


def test_a_direction_turns_evenly_from_piece_to_piece():
    corner = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]])
    angle = [math.atan2(y, x) for x, y in direction_at(corner, np.array([-5.0, 5.0, 10.0, 15.0, 40.0]))]
    assert angle == pytest.approx([0, 0, math.pi / 4, math.pi / 2, math.pi / 2])


def test_lanes_that_cross_in_the_direction_of_travel_are_found():
    across = LanesAcross.from_lanes((STRAIGHT, BACK, ASIDE), (LINE, FAR, NOWHERE))
    assert len(across.centre) == 2  # nothing crosses a line against its direction
    pairs = list(zip(across.line.tolist(), across.lane.tolist(), across.s.tolist(), strict=True))
    assert [pair[:2] for pair in pairs] == [(0, 0), (0, 1), (1, 0)]  # a lane runs on straight beyond its end
    assert [pair[2] for pair in pairs] == pytest.approx([50, 50, 250])
    assert across.e[:2] == pytest.approx([1.5, -1.5])


def test_a_line_that_was_moved_is_crossed_elsewhere():
    across = LanesAcross.from_lanes((STRAIGHT,), (LINE, FAR))
    moved = across.placed(np.array([100.0, 0.0]), np.array([[2.0, 0.5], [0.0, 0.0]]), np.array([7, 9]))
    assert moved.line.tolist() == [7, 9]
    assert moved.s == pytest.approx([52, 250])
    assert moved.e == pytest.approx([2.0, 0.0])
    rows, pairs = moved.crossings(np.array([9, 8, 7, 9]))
    assert (rows.tolist(), pairs.tolist()) == ([0, 2, 3], [1, 0, 1])
    there = moved.inside(
        np.array([[-110.0, 1.0], [-110.0, 2.5], [-160.0, 0.0], [-90.0, 1.0]]), np.tile([1.0, 0], (4, 1))
    )
    assert there.vehicle.tolist() == [0, 3]  # within the width, and on the lane
    assert there.feet.s == pytest.approx([40, 60])
    assert there.feet.e == pytest.approx([1, 1])
    assert len(moved.inside(np.array([[-110.0, 1.0]]), np.array([[-1.0, 0.0]])).vehicle) == 0


def test_there_may_be_nothing():
    for lanes, lines in (((), ()), ((STRAIGHT,), ()), ((), (LINE,))):
        across = LanesAcross.from_lanes(lanes, lines)
        assert len(across.line) == 0
        assert len(across.inside(np.zeros((3, 2)), np.zeros((3, 2))).vehicle) == 0
        assert len(across.crossings(np.array([0, 0]))[0]) == 0

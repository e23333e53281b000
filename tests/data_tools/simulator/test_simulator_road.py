"""Roads and lanes: arc length, headings and metric agree with finite differences of positions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from data_tools.simulator.road import LaneOrder, Lanes, Road, curved_road, smooth_step, smooth_step_slope


def winding_road() -> Road:
    return curved_road(600.0, [(200.0, 1.0, 200.0), (420.0, -0.8, 150.0)], np.array([700.0, -300.0]), 0.4)


def test_the_centre_line_has_unit_speed_and_turns_by_its_bends() -> None:
    road = winding_road()
    s = np.linspace(0, 600, 2001)
    step = np.diff(road.position(s, np.zeros_like(s)), axis=0)
    assert np.linalg.norm(step, axis=1) == pytest.approx(np.full(2000, 0.3), rel=1e-3)
    assert road.heading_at(np.array(0.0)) == pytest.approx(0.4)
    assert road.heading_at(np.array(300.0)) == pytest.approx(1.4, abs=1e-6)
    assert road.heading_at(np.array(600.0)) == pytest.approx(0.6, abs=1e-6)
    assert np.abs(road.curvature).max() == pytest.approx(2 * 0.8 / 150, rel=1e-3)


def test_beyond_its_ends_a_road_runs_on_straight() -> None:
    road = winding_road()
    ahead = road.position(np.array([600.0, 650.0]), np.array([2.0, 2.0]))
    assert ahead[1] - ahead[0] == pytest.approx(50 * np.array([np.cos(0.6), np.sin(0.6)]), abs=1e-6)


@settings(max_examples=50)
@given(s=st.floats(20, 580), d=st.floats(-12, 12), slope=st.floats(-0.3, 0.3), sign=st.sampled_from([1, -1]))
def test_heading_and_metric_are_those_of_the_path(s: float, d: float, slope: float, sign: int) -> None:
    lanes = Lanes(winding_road(), np.array([d]), np.array([sign]))
    lane = np.zeros(2, dtype=np.int64)
    h = 0.5
    along = np.array([s - h, s + h])
    offset = np.array([d - h * slope, d + h * slope])
    position, _ = lanes.pose(lane, along, offset, np.full(2, slope))
    _, heading = lanes.pose(lane[:1], np.array([s]), np.array([d]), np.array([slope]))
    metric = lanes.metric(lane[:1], np.array([s]), np.array([d]), np.array([slope]))
    chord = position[1] - position[0]
    assert np.linalg.norm(chord) / (2 * h) == pytest.approx(metric[0], rel=5e-3)
    direction = np.array([np.cos(heading[0]), np.sin(heading[0])])
    assert direction @ chord / np.linalg.norm(chord) == pytest.approx(1.0, abs=1e-4)


def test_smooth_step_has_the_slope_it_says() -> None:
    x = np.linspace(-0.2, 1.2, 1401)
    assert smooth_step(np.array([-1.0, 0.0, 0.5, 1.0, 2.0])) == pytest.approx([0, 0, 0.5, 1, 1])
    assert np.gradient(smooth_step(x), x) == pytest.approx(smooth_step_slope(x), abs=2e-3)


def test_an_on_ramp_approaches_its_place_beside_the_road() -> None:
    lanes = Lanes(
        curved_road(600.0, [], np.zeros(2), 0.0),
        np.array([-2.0, -5.5, 2.0]),
        np.array([1, 1, -1]),
        ending=1,
        end=400.0,
        opening=300.0,
        approach=25.0,
        approach_length=100.0,
    )
    s = np.array([100.0, 200.0, 250.0, 300.0, 390.0])
    d, slope = lanes.lateral(np.ones(5, dtype=np.int64), s)
    assert d == pytest.approx([-30.5, -30.5, -18.0, -5.5, -5.5])
    assert slope[[0, 3, 4]] == pytest.approx([0, 0, 0])
    h = 1e-4
    after, _ = lanes.lateral(np.array([1]), np.array([250.0 + h]))
    assert slope[2] == pytest.approx((after[0] - d[2]) / h, rel=1e-3)
    none = np.array([-1, -1, -1])
    assert lanes.neighbour(np.array([0, 1, 2]), 1).tolist() == [1, -1, -1]
    assert lanes.neighbour(np.array([0, 1, 2]), -1).tolist() == [-1, 0, -1]
    assert not lanes.may_change(np.array([0, 1, 2]), none, np.full(3, 350.0)).any()
    assert not lanes.may_change(np.array([0]), np.array([1]), np.array([350.0]))[0]  # nobody enters a lane that ends
    assert lanes.may_change(np.array([1, 1]), np.array([0, 0]), np.array([350.0, 250.0])).tolist() == [True, False]


@given(st.data())
def test_neighbours_are_those_of_a_plain_search(data: st.DataObject) -> None:
    n = data.draw(st.integers(0, 12))
    s = np.array(data.draw(st.lists(st.integers(0, 900), min_size=n, max_size=n, unique=True)), dtype=np.float64)
    lane = np.array(data.draw(st.lists(st.integers(0, 2), min_size=n, max_size=n)), dtype=np.int64)
    also = np.array(data.draw(st.lists(st.integers(-1, 2), min_size=n, max_size=n)), dtype=np.int64)
    also = np.where(also == lane, -1, also)
    order = LaneOrder.by_position(s, np.stack([lane, also], axis=1))
    target = np.array(data.draw(st.lists(st.integers(-1, 2), min_size=n, max_size=n)), dtype=np.int64)
    ahead, behind = order.ahead(target, s), order.behind(target, s)
    for i in range(n):
        there = [j for j in range(n) if target[i] >= 0 and target[i] in (lane[j], also[j])]
        front = [j for j in there if s[j] > s[i]]
        rear = [j for j in there if s[j] < s[i]]
        assert ahead[i] == (min(front, key=lambda j: s[j]) if front else -1)
        assert behind[i] == (max(rear, key=lambda j: s[j]) if rear else -1)

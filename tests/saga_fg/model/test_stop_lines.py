"""Lights, stop lines, lanes and cones: their laws, who heeds whom, and that each node type keeps to its own."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg import InputError
from saga_fg.model.edge_rules import CLEARANCE, OFFSET_TIME, Attached, Following, RigidCoupling, anticipated
from saga_fg.model.graph_building import build_graph
from saga_fg.model.interactions import SharedVelocity
from saga_fg.model.map_rules import CONE_RATE, PREVIEW, ConeLine, GreenLight, InLane, RedLight, Stopping
from saga_fg.numerics.geometry import feet
from saga_fg.types.road_map import (
    STATES,
    Lane,
    LanesAcross,
    RoadMap,
    SignalSettings,
    StopLine,
    TrafficLight,
    colour_updated,
    colours,
)
from tests.saga_fg.road_scenes import bent_lane, queue, table, taper


def pull(nodes, rule):
    """The acceleration (n, 2) of all nodes that the edges of a rule make at the present estimate."""
    total = np.zeros((len(nodes), 2))
    for edges in build_graph(nodes, [rule]).edges:
        for k, (i, j) in enumerate(zip(edges.target.tolist(), edges.source.tolist(), strict=True)):
            x_i, x_j = (state(nodes, row) for row in (i, j))
            change = edges.rate[k] * (edges.A_self[k] @ x_i + edges.A_other[k] @ x_j + edges.b[k])
            total[i] += change[nodes.types[i].index(("vx", "vy"))]
    return total


def state(nodes, row):
    kind = nodes.types[row]
    x = np.zeros(kind.dim)
    x[kind.index(("x", "y"))] = nodes.position[row]
    if kind.has(("vx", "vy")):
        x[kind.index(("vx", "vy"))] = nodes.velocity[row]
    return x


# the light


@given(belief=st.lists(st.floats(0.01, 1), min_size=4, max_size=4), dt=st.floats(0, 50), parts=st.integers(1, 5))
def test_a_belief_is_predicted_over_any_interval_alike(belief, dt, parts):
    """Chapman and Kolmogorov: in one step or in several; it stays a distribution and forgets what was seen."""
    signals, p = SignalSettings(), np.array([belief]) / sum(belief)
    once, often = signals.predicted(p, dt), p
    for _ in range(parts):
        often = signals.predicted(often, dt / parts)
    assert np.allclose(once, often, atol=1e-9)
    assert np.allclose(once.sum(), 1)
    assert (once >= -1e-12).all()
    assert np.allclose(signals.predicted(p, 1e4), signals.stationary, atol=1e-6)


def test_beliefs_change_in_the_order_of_colours_and_mix():
    signals = SignalSettings(red_duration=10, amber_duration=3, green_duration=12)
    red = signals.predicted(np.array([[1.0, 0, 0, 0]]), 0.01)[0]
    assert red[STATES.index("starting")] == pytest.approx(0.001, rel=0.01)
    assert red[STATES.index("amber")] + red[STATES.index("green")] < 1e-5
    assert np.allclose(signals.stationary, np.array([10, 3, 1.5, 12]) / 26.5)
    assert np.allclose(colours(signals.stationary), np.array([10, 3, 13.5]) / 26.5)
    beliefs = np.array([[0.3, 0.1, 0.2, 0.4], [0.5, 0.2, 0.0, 0.3], [0.1, 0.1, 0.1, 0.7]])
    assert np.allclose(SignalSettings().closed(beliefs), [0.4, 0.7, 0.2])
    assert np.allclose(SignalSettings().open(beliefs), [0.4, 0.3, 0.7])


@given(accuracy=st.floats(0.4, 0.999), colour=st.sampled_from(range(3)))
def test_reports_of_a_colour_persuade_as_bayes_says(accuracy, colour):
    belief = np.array([1 / 3, 1 / 3, 1 / 6, 1 / 6])
    belief = colour_updated(belief, colour, accuracy)
    assert colours(belief)[colour] == pytest.approx(accuracy)
    again = colours(colour_updated(belief, colour, accuracy))
    assert again[colour] == pytest.approx(accuracy**2 / (accuracy**2 + (1 - accuracy) ** 2 / 2), rel=1e-5)
    for _ in range(100):
        belief = colour_updated(belief, colour, accuracy)
    other = (colour + 1) % 3
    for _ in range(100):  # whatever was believed, another colour can still be learnt
        belief = colour_updated(belief, other, accuracy)
    assert colours(belief).argmax() == other


# the stop line


@given(turn=st.floats(-3, 3), speed=st.floats(3, 8), gap=st.floats(10, 60))
def test_stopping_is_the_even_deceleration_to_the_line(turn, speed, gap):
    """The linearised law at its estimate, in any direction; and its derivatives against finite differences."""
    u = np.array([np.cos(turn), np.sin(turn)])
    law = Stopping(margin=1.0)
    place = -(gap + 2 + 1.0) * u
    ends = np.stack([[-u[1], u[0]], [u[1], -u[0]]]) * 2
    rows = [("car", *place, speed, turn, 4.0), ("stop_line", 0, 0, 0, turn, 0)]
    nodes = table(rows, np.array([0.0, 1.0]), {1: ends})
    A_self, A_other, b = (part[0] for part in law.triples(nodes, np.array([0]), np.array([1])))
    x, line = state(nodes, 0), np.zeros(2)
    assert np.allclose((A_self @ x + A_other @ line + b)[2:], -u * speed**2 / (2 * gap), atol=1e-9)

    def needed(p, v, q):
        return -u * (u @ v) ** 2 / (2 * (u @ (q - p) - 3.0))

    eps = 1e-6
    for axis, e in enumerate(np.eye(2) * eps):
        by_v = (needed(place, speed * u + e, line) - needed(place, speed * u - e, line)) / (2 * eps)
        by_p = (needed(place + e, speed * u, line) - needed(place - e, speed * u, line)) / (2 * eps)
        assert np.allclose(A_self[2:, 2 + axis], by_v, atol=1e-5)
        assert np.allclose(A_self[2:, axis], by_p, atol=1e-5)
        assert np.allclose(A_other[2:, axis], -by_p, atol=1e-5)


def test_a_red_light_stops_the_first_who_can_stop():
    target, source, rate = RedLight().pairs(queue())
    assert sorted(target.tolist()) == [0, 3]
    assert source.tolist() == [4, 4]
    assert rate == pytest.approx([1.0, 1.0])
    assert RedLight().pairs(queue(closed=0.4)).rate == pytest.approx([0.4, 0.4])
    acceleration = pull(queue(), RedLight())
    assert acceleration[0, 0] == pytest.approx(-(10**2) / (2 * (30 - 2 - 3)))
    assert np.allclose(acceleration[[1, 2, 4]], 0)
    rows = [("car", -8, 0, 12, 0, 4), ("car", -30, 0, 12, 0, 4), ("stop_line", 0, 0, 0, 0, 0)]
    nodes = table(rows, np.array([0, 0, 1.0]), {2: np.array([[0, 1.75], [0, -1.75]])})
    assert RedLight().pairs(nodes).target.tolist() == [1]


@pytest.mark.parametrize(
    "row",
    [("car", -30, 4, 10, 0, 4), ("car", 20, 0, 10, 0, 4), ("car", -30, 0, 10, math.pi, 4), ("car", -300, 0, 9, 0, 4)],
)
def test_who_does_not_come_to_the_line_is_not_stopped(row):
    """Beside it, beyond it, the other way, far away."""
    nodes = table([row, ("stop_line", 0, 0, 0, 0, 0)], np.array([0, 1.0]), {1: np.array([[0, 1.75], [0, -1.75]])})
    assert len(RedLight().pairs(nodes).target) == 0


@pytest.mark.parametrize(("front", "speed"), [(4.0, 0.3), (9.0, 1.5), (-1.5, 0.5)])
def test_a_slow_vehicle_near_a_closed_line_comes_to_rest(front, speed):
    """It does not creep up to the line, and may stand a little beyond."""
    rows = [("car", -front - 2, 0, speed, 0, 4), ("stop_line", 0, 0, 0, 0, 0)]
    nodes = table(rows, np.array([0, 1.0]), {1: np.array([[0, 1.75], [0, -1.75]])})
    assert pull(nodes, RedLight())[0, 0] == pytest.approx(-speed)


def open_line(rows, weight=1.0):
    nodes = table([*rows, ("stop_line", 0, 0, 0, 0, 0)], None, {len(rows): np.array([[0, 1.75], [0, -1.75]])})
    return replace(nodes, open=np.append(np.zeros(len(rows)), weight))


def test_an_open_line_lets_the_first_go_and_who_has_crossed_speed_up():
    rule = GreenLight()
    queue = [("car", -5, 0, 0, 0, 4), ("car", -12, 0, 0, 0, 4)]
    assert pull(open_line(queue), rule)[:2, 0] == pytest.approx([2.0, 0.0])
    assert pull(open_line(queue, 0.3), rule)[0, 0] == pytest.approx(0.6)
    assert pull(open_line([("car", -5, 0, 6, 0, 4)]), rule)[0, 0] == pytest.approx(0.8)
    assert len(rule.pairs(open_line([("car", -5, 0, 12, 0, 4)])).target) == 0  # nobody is slowed down
    rule = GreenLight()
    rows = [("car", 6, 0, 5, 0, 4), ("car", -3, 0, 4, 0, 4)]
    assert pull(open_line(rows), rule)[:2, 0] == pytest.approx([1.0, 1.2])
    assert len(rule.pairs(open_line([("car", 30, 0, 5, 0, 4)])).target) == 0
    assert len(rule.pairs(open_line([("car", 6, 0, 5, math.pi, 4)])).target) == 0


def test_where_a_lane_ends_vehicles_go_straight_on_to_the_line():
    """The lane that crosses the line begins 10 m before it; a vehicle in the lane before comes to it all the same."""
    nodes = table(
        [("car", -30, 0, 10, 0, 4), ("stop_line", 0, 0, 0, 0, 0)],
        np.array([0, 1.0]),
        {1: np.array([[0, 1.75], [0, -1.75]])},
    )
    line = StopLine("line", (0.0, 1.75), (0.0, -1.75), "light")
    short = Lane("short", ((-10.0, 0.0), (5.0, 0.0)))
    before = Lane("before", ((-100.0, 0.2), (-10.0, 0.2)))
    for lanes in ((), (short,), (short, before)):
        across = replace(LanesAcross.from_lanes(lanes, [line]), line=np.ones(len(lanes), dtype=np.int64))
        assert RedLight().pairs(replace(nodes, lanes=across)).target.tolist() == [0]


def line_round_the_bend(*others):
    """Vehicles `others`, one in a bent lane, the lane, and a stop line that it would miss straight on."""
    nodes, n = bent_lane(), len(others)
    lane = nodes.outline[1]
    end, before = lane[-1], lane[-2]
    t = (end - before) / np.linalg.norm(end - before)
    across = np.array([-t[1], t[0]])
    rows = [*others, ("car", *nodes.position[0], 8.0, 0.2, 4), ("lane", *nodes.position[1], 0, 0, 0)]
    rows.append(("stop_line", *(end - t), 0, math.atan2(t[1], t[0]), 0))
    with_line = table(
        rows,
        np.append(np.zeros(n + 2), 1.0),
        {n + 1: lane, n + 2: np.stack([end - t + 1.75 * across, end - t - 1.75 * across])},
        {n + 1: 3.5},
    )
    left, right = (tuple(point) for point in with_line.outline[n + 2].tolist())
    mapped = Lane("lane", tuple(map(tuple, lane.tolist()))), StopLine("line", left, right, "light")
    crossing = LanesAcross.from_lanes(mapped[:1], mapped[1:]).placed(np.zeros(2), np.zeros((1, 2)), np.array([n + 2]))
    return lane, replace(with_line, lanes=crossing)


def test_the_way_to_a_line_is_along_the_lane():
    lane, with_line = line_round_the_bend()
    assert with_line.lanes.line.tolist() == [2]
    assert len(RedLight().pairs(replace(with_line, lanes=None)).target) == 0  # straight on it would miss the line
    assert RedLight().pairs(with_line).target.tolist() == [0]
    at = feet(lane, with_line.position[:1])
    arc, speed = 50 * 1.2 - 1 - at.s[0], 8.0 * (at.direction[0] @ (np.cos(0.2), np.sin(0.2)))
    rule = RedLight(full_deceleration=0.3)
    expected = -(speed**2) / (2 * (arc - 2 - rule.interaction.margin))
    assert pull(with_line, rule)[0] @ at.direction[0] == pytest.approx(expected, rel=1e-3)  # an arc of chords


def test_who_takes_no_part_changes_nothing_for_others():
    """Lanes keep their lines where a node before them takes no part."""
    _, alone = line_round_the_bend()
    _, with_weak = line_round_the_bend(("car", 500.0, 500.0, 8.0, 0.0, 4))
    expected = build_graph(alone, [RedLight()]).edges
    found = build_graph(with_weak, [RedLight()], interacting=np.arange(4) > 0).edges
    assert len(found) == len(expected) == 1
    assert (found[0].target - 1, found[0].source - 1) == (expected[0].target, expected[0].source) == (0, 2)
    assert found[0].b == pytest.approx(expected[0].b)
    assert len(with_weak.select(np.array([0, 1])).lanes.line) == 0


# lanes


def test_a_vehicle_turns_with_its_lane():
    """At the centre, along the lane: the pull is the centripetal acceleration v^2 / r, to first order."""
    nodes = bent_lane()
    at = feet(nodes.outline[1], nodes.position[:1])
    placed = table(
        [("car", *at.point[0], 8.0, math.atan2(*at.direction[0][::-1]), 4), ("lane", *nodes.position[1], 0, 0, 0)],
        np.zeros(2),
        nodes.outline,
        nodes.width,
    )
    rule = InLane()
    n = np.array([-at.direction[0, 1], at.direction[0, 0]])
    assert pull(placed, rule)[0] @ n == pytest.approx(8.0**2 / 50, rel=0.1)


@given(turn=st.floats(-3, 3), x=st.floats(-500, 500), y=st.floats(-500, 500))
def test_lanes_pull_alike_at_every_place_and_in_every_direction(turn, x, y):
    here, there = pull(bent_lane(), InLane())[0], pull(bent_lane(turn, (x, y)), InLane())[0]
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    assert np.allclose(R @ here, there, atol=1e-6)


def test_who_leaves_a_lane_or_is_pushed_out_by_cones_is_let_go():
    straight = {1: np.array([[-50.0, 0.0], [50.0, 0.0]])}
    rows = [("car", 0, 1.0, 10, 0.2, 4), ("lane", 0, 0, 0, 0, 0)]
    leaving = InLane().pairs(table(rows, np.zeros(2), straight, {1: 3.5}))
    assert leaving.rate[0] < 0.1
    rows[0] = ("car", 0, 2.5, 10, 0, 4)
    assert len(InLane().pairs(table(rows, np.zeros(2), straight, {1: 3.5})).target) == 0
    rows = [("car", 0, 0, 10, 0, 4), ("lane", 0, 0, 0, 0, 0)]
    rows += [("traffic_cone", 10 + 5 * k, -2 + k, 0, 0, 0.4) for k in range(5)]
    nodes = table(rows, np.zeros(7), {1: np.array([[-50.0, 0.0], [50.0, 0.0]])}, {1: 3.5})
    assert len(InLane().pairs(nodes).target) == 1
    assert len(InLane(cones=True).pairs(nodes).target) == 0


# cones


def test_cones_push_aside_whose_lane_they_close_to_where_the_edge_is_just_cleared():
    nodes = taper()
    acceleration = pull(nodes, ConeLine())
    assert acceleration[0, 1] > 0.5
    assert acceleration[0, 0] == pytest.approx(0)
    assert np.allclose(acceleration[1:], 0)
    # Looking 15 m ahead, at the second cone, which is at y = -1: the way aside there is clearance - 1.
    assert pull(taper(), ConeLine())[0, 1] == pytest.approx(CONE_RATE * (CLEARANCE - 1) / PREVIEW)
    nodes = taper()
    mirrored = table([(str(nodes.label[k]), *(nodes.position[k] * (1, -1)), 10.0 * (k < 2), 0, 4) for k in range(7)])
    assert np.allclose(pull(mirrored, ConeLine()) * (1, -1), pull(nodes, ConeLine()))


def test_the_car_beside_knows_that_cones_push_another_into_its_lane():
    """Figure 1 of the paper: car A, in the lane beside, follows car B before B is there."""
    nodes = taper()
    plain = Following(interaction=SharedVelocity(), lateral_scale=0.8)
    assert len(plain.pairs(nodes).target) == 0
    edges = replace(plain, cones=True).pairs(nodes)
    assert (edges.target.tolist(), edges.source.tolist()) == ([1], [0])
    moved = anticipated(nodes, ("car",))
    assert moved[0].tolist() == [0, 2.0 + CLEARANCE]
    assert moved[1].tolist() == [-12, 2.0 + CLEARANCE]


# trailers and riders


def test_attached_is_the_nearest_that_touches_and_feels_changes_alone():
    rows = [("truck", 0, 0, 10, 0, 7), ("trailer", -8.5, 0, 10, 0, 8), ("truck", -9, 3.5, 10, 0, 7)]
    target, source, _ = Attached().pairs(table(rows))
    assert sorted(zip(target.tolist(), source.tolist(), strict=True)) == [(0, 1), (1, 0)]
    rows[1] = ("trailer", -8.5, 0, 2, 0, 8)
    assert all(rate < 0.01 for rate in Attached().pairs(table(rows)).rate)
    nodes = table([("truck", 0, 0, 10, 0, 7), ("trailer", -8.5, 0, 10, 0, 8)])
    assert np.allclose(pull(nodes, Attached()), 0)
    A_self, A_other, b = (part[0] for part in RigidCoupling().triples(nodes, np.array([1]), np.array([0])))
    ahead = state(nodes, 0) + np.array([1.0, 0, -2.0, 0])
    assert np.allclose((A_self @ state(nodes, 1) + A_other @ ahead + b)[2:], [-2.0 + 1.0 / OFFSET_TIME, 0])


# the map


def test_a_stop_line_looks_where_traffic_goes():
    assert StopLine("a", (0, 2), (0, -2), "l").heading == pytest.approx(0)
    assert StopLine("a", (-2, 0), (2, 0), "l").heading == pytest.approx(math.pi / 2)


def test_a_map_that_makes_no_sense_is_refused(subtests):
    for make, message in [
        (lambda: RoadMap((), (StopLine("a", (0, 1), (0, 0), "b"),)), "there is no traffic light 'b'"),
        (lambda: RoadMap((TrafficLight("a", (0, 0)), TrafficLight("a", (1, 1)))), "'a' occurs twice"),
        (lambda: StopLine("a", (0, 1), (0, 1), "b"), "two different ends"),
        (lambda: StopLine("a", (0, 1), (0, 0), sign="merge"), "sign: expected one of stop"),
        (lambda: Lane("a", ((0, 0),)), "at least two points"),
        (lambda: TrafficLight("", (0, 0)), "expected a name"),
        (lambda: TrafficLight("a", (0, math.nan)), "finite numbers"),
        (lambda: RoadMap(deviation=0), "deviation"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            make()

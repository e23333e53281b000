"""Edges that answer for themselves, and the lines at which vehicles halt."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from saga_fg import ConstantVelocity, NodeType, Sensor, Tracker, TrackerSettings
from saga_fg.model.edge_rules import Following, Neighbours
from saga_fg.model.interactions import NodeTable, SharedVelocity
from saga_fg.model.sensor import NoiseModel
from saga_fg.tracking.edge_record import ACCELERATION, MAX_RATIO, EdgeRecord
from saga_fg.tracking.halting_places import HaltingPlaces
from tests.saga_fg.traffic_frames import columns, frame, run, seen

FOLLOWING = Following(SharedVelocity(), rate=2.0, max_gap=60.0, gap_scale=np.inf, parked=True)
SETTINGS = TrackerSettings(edges=(FOLLOWING,), edge_prior=0.9)
CAR = NodeType("car", ConstantVelocity(1.0))


def nodes(position, velocity, ids=None, heading=0.0, moved=1.0):
    """Cars, as edge rules see them."""
    position, velocity = np.asarray(position, dtype=float), np.asarray(velocity, dtype=float)
    n = len(position)
    ids = np.arange(n) if ids is None else np.array(ids)
    yaw, variance = np.full(n, heading, dtype=float), np.full(n, 0.04)
    return NodeTable(
        ids, np.full(n, "car"), (CAR,) * n, position, velocity, yaw, np.full(n, 4.5), variance, np.full(n, moved)
    )


def moved(table, dt=1.0):
    return replace(table, position=table.position + dt * table.velocity)


def after_a_second(before, after, rules=(FOLLOWING,)):
    """The record of cars that move as `before` says for a second, and then as `after` says."""
    here, start = np.ones(len(before), dtype=bool), moved(before, -1.0)
    record = EdgeRecord().later(rules, start, here, 9.0).later(rules, before, here, 10.0)
    return record.later(rules, replace(after, position=before.position + after.velocity), here, 11.0)


def probability(record, table, prior=0.9, halting=None, time=11.0, target=0, source=1):
    governing = record.governing((FOLLOWING,), halting or HaltingPlaces(), prior, time)
    return governing(0, table, np.array([target]), np.array([source]))[0]


def test_a_trial_is_the_ratio_of_two_normal_densities():
    places, v = [(0, 0), (20, 0)], np.array([[0.0, 0.0], [5.0, 0.0]])
    record = after_a_second(nodes(places, v), nodes(places, [(1.0, 0), (5.0, 0)]))
    asked, variance = 5.0 * (1 - (1 - np.exp(-2.0)) / 2.0), 0.04 + 0.04 + ACCELERATION**2
    ratio = (1.0**2 - (1.0 - asked) ** 2) / (2 * variance)
    assert abs(ratio) < MAX_RATIO
    assert record.sums[0, 1, 0, 1] == (pytest.approx(ratio), 11.0)


def test_who_stands_while_the_leader_leaves_is_soon_not_led_by_him_and_who_follows_is():
    places = [(0, 0), (20, 0)]
    waits = nodes(places, [(0, 0), (8, 0)])
    record, here, found = EdgeRecord(), np.ones(2, dtype=bool), []
    for time in np.arange(9.0, 15.0):
        record = record.later((FOLLOWING,), moved(waits, time - 11.0), here, time)
        found.append(probability(record, waits, time=time))
    assert found == sorted(found, reverse=True)
    assert found[1] == found[0] > found[2]
    assert found[-1] < 0.05
    follows = after_a_second(waits, nodes(places, [(4, 0), (8, 0)]))
    assert probability(follows, waits) > 0.95
    assert probability(EdgeRecord(), waits) == pytest.approx(0.9)


def test_who_leaves_a_leader_that_speeds_up_still_follows_him_when_he_brakes():
    waits = nodes([(0, 0), (20, 0)], [(0, 0), (8, 0)])
    record = after_a_second(waits, waits)
    assert probability(record, waits) < 0.8
    braking = nodes([(0, 0), (20, 0)], [(8, 0), (0, 0)])
    assert probability(record, braking) == pytest.approx(0.9)


def test_records_fade_and_tell_about_other_vehicles_at_the_place_alone():
    places = [(0, 0), (20, 0)]
    waits = nodes(places, [(0, 0), (8, 0)])
    record = after_a_second(waits, waits)
    assert probability(record, waits, time=2000.0) == pytest.approx(0.9, abs=1e-3)
    others = nodes(places, [(0, 0), (8, 0)], ids=[7, 8])
    elsewhere = nodes([(0, 200), (20, 200)], [(0, 0), (8, 0)], ids=[7, 8])
    across = nodes(places, [(0, 0), (4, 8)], ids=[7, 8], heading=np.pi / 2)
    here, there, other_way = (probability(record, table) for table in (others, elsewhere, across))
    assert here < min(there, other_way)
    assert there == other_way < 0.9  # all know that the rule has failed once


def test_who_is_not_seen_at_the_end_tells_nothing_and_who_is_not_seen_begins_nothing():
    table = nodes([(0, 0), (20, 0)], [(0, 0), (8, 0)])
    both, one = np.array([True, True]), np.array([False, True])
    for seen_at, trials in (((both, both, one), True), ((both, one, both), False), ((one, both, both), False)):
        record = EdgeRecord()
        for time, here in enumerate(seen_at):
            begun, record = record.trials, record.later((FOLLOWING,), table, here, float(time))
        assert (len(begun) > 0, record.sums) == (trials, {})
    late = EdgeRecord().later((FOLLOWING,), table, both, 0.0).later((FOLLOWING,), table, both, 5.0)
    assert late.trials == ()


def test_information_gain_does_not_hide_what_an_edge_would_say_of_a_hidden_object():
    places, v = [(0, 0), (20, 0)], [(0, 0), (5, 0)]
    gains = replace(FOLLOWING, information_gain=True)
    whole, weighted = (after_a_second(nodes(places, v), nodes(places, v), (rule,)) for rule in (FOLLOWING, gains))
    assert weighted.sums == whole.sums


def halts(places, rows, time):
    """Cars that come one by one, each of which stands at (0, 0) for two seconds, or not, and goes on."""
    for number, stands in enumerate(rows):
        for x in np.arange(-10, 8, 0.5):
            wait = [0.0] * 20 if stands and x == 0 else []
            for v in [5.0, *wait]:
                table = nodes([(x, 0.1 * number)], [(v, 0.0)], ids=[number])
                places, time = places.later(table, np.ones(1, dtype=bool), time), time + 0.1
    return places


def test_halts_in_one_place_are_one_line_with_the_share_of_those_that_halted():
    places = halts(HaltingPlaces(), [True, True, False, True], 0.0)
    assert len(places.lines) == 1
    assert places.lines.probability[0] == pytest.approx(3 / 5)
    assert np.abs(places.lines.position[0]).max() < 0.5
    assert len(halts(HaltingPlaces(), [False] * 3, 0.0).lines) == 0


def test_a_line_ends_the_edge_to_a_leader_who_has_crossed_it():
    places = halts(HaltingPlaces(), [True, True, True], 0.0)
    halt = places.lines.probability[0]
    pairs = {
        "crossed": ([(-1, 0), (10, 0)], halt),
        "both before": ([(-20, 0), (-1, 0)], 0.0),
        "both beyond": ([(6, 0), (16, 0)], 0.0),
        "other lane": ([(-1, 3.5), (10, 3.5)], 0.0),
    }
    for name, (where, expected) in pairs.items():
        table = nodes(where, [(5, 0), (5, 0)])
        assert places.across(table, np.array([0]), np.array([1]))[0] == pytest.approx(expected), name
    faster, slower = (nodes([(-1, 0), (10, 0)], [(5, 0), (v, 0)]) for v in (7, 3))
    assert probability(EdgeRecord(), faster, halting=places) == pytest.approx(0.9 * (1 - halt))
    assert probability(EdgeRecord(), slower, halting=places) == pytest.approx(0.9)


@pytest.mark.parametrize("case", ["parked", "queue", "creeps"])
def test_no_line_where_nobody_halts_of_his_own(case):
    places = HaltingPlaces()
    for k in range(40):
        if case == "parked":
            table = nodes([(0, 0)], [(0, 0)], moved=0.0)
        elif case == "queue":
            table = nodes([(0, 0), (7, 0)], [(0, 0), (2, 0)])
        else:
            table = nodes([(0.1 * k, 0)], [(1.0, 0)])
        places = places.later(table, np.ones(len(table), dtype=bool), 0.1 * k)
    assert len(places.lines) == 0


def crossing(settings, hidden=np.inf):
    """A car stands at a line, with a heading; another stands before it and then goes away. Both are seen at 10 Hz, the
    first until it is `hidden`. Returns the tracker and its tracks."""
    rng, leader = np.random.default_rng(0), lambda t: 12.0 + np.maximum(t - 3.0, 0.0) ** 2
    frames = [
        frame(t, place[:1] if t >= hidden else place, yaw=0.0)
        for t in np.arange(0, 10, 0.1)
        for place in [np.array([[leader(t), 0.0], [0.0, 0.0]]) + 0.05 * rng.normal(size=(2, 2))]
    ]
    tracker = Tracker(settings, {"default": Sensor(noise={"default": NoiseModel(position=0.1)})})
    return tracker, run(tracker, frames)


def test_a_hidden_car_that_waited_is_not_pulled_after_its_leader():
    settings = replace(SETTINGS, stationary_share=0.0, max_coasting=10.0)
    place = {}
    for prior in (0.9, 1.0):
        _, tracks = crossing(replace(settings, edge_prior=prior), hidden=8.0)
        place[prior] = tracks[90].boxes.position[tracks[90].id == tracks[40].id[1], 0][0]
    assert place[0.9] < 0.3 * place[1.0]
    assert place[1.0] > 10.0


def test_a_tracker_goes_on_from_a_snapshot_with_what_its_edges_have_told():
    tracker, _ = crossing(SETTINGS)
    assert tracker._state.edge_record.sums
    twin = pickle.loads(pickle.dumps(tracker))
    later = seen(
        np.random.default_rng(1), lambda t: np.array([[12 + (t - 3) ** 2, 0.0], [0.0, 0.0]]), np.arange(10.0, 12, 0.1)
    )
    assert [columns(a) for a in run(tracker, later)] == [columns(b) for b in run(twin, later)]


def test_with_certain_edges_nothing_is_recorded():
    tracker, tracks = crossing(replace(SETTINGS, edge_prior=1.0))
    assert tracker._state.edge_record.sums == {}
    _, without = crossing(replace(SETTINGS, edge_prior=1.0, edges=()))
    assert [columns(t) for t in tracks] != [columns(t) for t in without]


def test_rules_between_pedestrians_answer_too():
    group = Neighbours(classes=("pedestrian",), rate=1.0, distance_scale=2.0, max_distance=4.5, min_speed=0.0)
    table = nodes([(0, 0), (1, 0)], [(0.5, 0.5), (1.5, 0)])
    walk = replace(table, label=np.full(2, "pedestrian"), velocity=np.array([[0.2, 0.0], [2.2, 0.0]]))
    assert after_a_second(walk, walk, (group,)).sums

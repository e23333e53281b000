"""Edge rules: who is coupled with whom, and how strongly."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg import InputError
from saga_fg.model.edge_rules import (
    SPREAD,
    UNSEEN_ACCELERATION,
    Following,
    Neighbours,
    Pairs,
    build_graph,
    traffic_rules,
)
from saga_fg.numerics.geometry import yaw_transform
from tests.saga_fg.model.drawn_traffic import bend, edges, joined, leaders, random_traffic, straight, table

seeds = st.integers(0, 2**32 - 1)


# what neighbours have to tell


def test_an_edge_counts_as_its_source_would_as_a_measurement_of_the_target():
    nodes = table([[0.0, 0.0], [3.0, 0.0]], 0.0)
    for s_i, s_j in ((0.1, 0.1), (9.0, 0.1), (0.1, 9.0)):
        known = replace(nodes, velocity_variance=np.array([s_i, s_j]))
        rate, full = (edges(Neighbours(information_gain=gain).pairs(known)) for gain in (True, False))
        assert rate[0][1] == pytest.approx(full[0][1] * s_i / (s_i + s_j + SPREAD**2))
        assert rate[1][0] == pytest.approx(full[1][0] * s_j / (s_i + s_j + SPREAD**2))


def test_a_follower_listens_to_its_leader_once_nobody_sees_it():
    rule, nodes = Following(information_gain=True), table(*straight(2))
    known = replace(nodes, velocity_variance=np.full(2, 0.1))
    seen, hidden = (rule.pairs(replace(known, unseen=np.array([0.0, t]))).rate[0] for t in (0.0, 3.0))
    full, unseen = Following().pairs(known).rate[0], 0.1 + (3 * UNSEEN_ACCELERATION) ** 2
    assert seen == pytest.approx(full * 0.1 / (0.2 + SPREAD**2))
    assert hidden == pytest.approx(full * unseen / (unseen + 0.1 + SPREAD**2))
    both = rule.pairs(replace(known, unseen=np.array([3.0, 3.0]))).rate[0]  # what leads unseen is no surer
    assert both == pytest.approx(full * unseen / (2 * unseen + SPREAD**2))


# who exists


def test_clutter_pulls_at_nobody():
    nodes = table([[0.0, 0.0], [3.0, 0.0], [0.0, 3.0]], 0.0)
    unsure = replace(nodes, existence=np.array([1.0, 0.25, 0.0]))
    full, weighted = (build_graph(each, [Neighbours()]).edges[0] for each in (nodes, unsure))
    of = {(i, j): rate for i, j, rate in zip(full.target, full.source, full.rate, strict=True)}
    assert 2 not in weighted.source
    for i, j, rate in zip(weighted.target, weighted.source, weighted.rate, strict=True):
        assert rate == pytest.approx(of[i, j] * unsure.existence[j])


def test_the_nearest_leader_that_exists_leads():
    nodes = table(*straight(4, gap=8.0))  # 3 behind 2 behind 1 behind 0
    rule = Following(gap_scale=np.inf)
    r = np.array([0.9, 0.6, 0.2, 1.0])
    graph = build_graph(replace(nodes, existence=r), [rule])
    rates = edges(Pairs(graph.edges[0].target, graph.edges[0].source, graph.edges[0].rate))
    assert rates[3] == pytest.approx({2: rule.rate * 0.2, 1: rule.rate * 0.8 * 0.6, 0: rule.rate * 0.8 * 0.4 * 0.9})
    assert rates[1] == pytest.approx({0: rule.rate * 0.9})
    assert sum(rates[3].values()) == pytest.approx(rule.rate * (1 - 0.1 * 0.4 * 0.8))


@given(seeds)
def test_certain_nodes_have_the_edges_of_nodes_of_which_no_existence_is_known(seed):
    nodes = random_traffic(np.random.default_rng(seed))
    rules = [Following(), Neighbours()]
    plain, certain = build_graph(nodes, rules), build_graph(replace(nodes, existence=np.ones(len(nodes))), rules)
    for one, other in zip(plain.edges, certain.edges, strict=True):
        assert np.array_equal(one.target, other.target)
        assert np.array_equal(one.source, other.source)
        assert one.rate == pytest.approx(other.rate)


def test_a_target_that_perhaps_moves_follows_at_the_expected_rate():
    nodes = table(*straight(2))
    full = Following(leaders="moving").pairs(nodes).rate[0]
    for target, source in ((0.4, 1.0), (1.0, 0.3), (0.5, 0.5)):
        known = replace(nodes, has_moved=np.array([source, target]))
        assert Following(leaders="moving").pairs(known).rate[0] == pytest.approx(full * target * source)
        assert Following(parked=True).pairs(known).rate[0] == pytest.approx(full)


def test_by_default_a_hidden_vehicle_follows_and_a_duplicate_leads_nobody():
    rule, _ = traffic_rules()
    apart, on_top = table(*straight(2)), table(*straight(2, gap=2.5))
    assert leaders(rule.pairs(apart)) == {1: 0}
    assert len(rule.pairs(on_top).target) == 0
    seen, hidden = (rule.pairs(replace(apart, unseen=np.array([0.0, t]))).rate[0] for t in (0.0, 1.0))
    assert hidden > 1.5 * seen


def test_who_was_never_seen_moving_queues_behind_a_leader_and_is_not_dragged_along_beside_it():
    """A heading known to 0.05 rad puts a car parked 2.2 m beside a stream 1.2 m beside leaders 20 m ahead."""
    rule = Following(parked=True, lateral_scale=0.8)

    def rate(lateral, moved):
        nodes = joined(straight(1, start=20.0), straight(1, lateral=lateral))
        return rule.pairs(replace(table(*nodes), has_moved=np.array([1.0, moved]))).rate.sum()

    assert rate(0.3, 0.0) > 0.7 * rate(0.3, 1.0), "in the queue"
    assert rate(1.2, 0.0) < 0.05 * rate(1.2, 1.0), "at the kerb"


# following


@pytest.mark.parametrize("heading", [0.0, 0.8, -2.5, np.pi])
def test_in_a_straight_queue_each_follows_the_one_ahead(heading):
    pairs = Following().pairs(table(*straight(6, heading=heading)))
    assert leaders(pairs) == {k: k - 1 for k in range(1, 6)}
    assert pairs.rate == pytest.approx(np.exp(-12.0 / 20.0))


@pytest.mark.parametrize("radius", [30.0, -30.0, 60.0, -200.0])
def test_in_a_bend_too(radius):
    nodes = table(*bend(6, radius, gap=10.0))
    assert leaders(Following().pairs(nodes)) == {k: k - 1 for k in range(1, 6)}


@pytest.mark.parametrize(
    "road", [straight, lambda n, *where: bend(n, 80.0, *where), lambda n, *where: bend(n, -60.0, *where)]
)
def test_a_leader_is_taken_from_the_own_lane_though_another_car_is_nearer(road):
    lane, gap = 3.5, 20.0
    nodes = table(*joined(road(4, gap), road(4, gap, -lane, 8.0)))
    found = leaders(Following().pairs(nodes))
    assert {k: found[k] for k in (1, 2, 3)} == {1: 0, 2: 1, 3: 2}
    assert {k: found[k] for k in (5, 6, 7)} == {5: 4, 6: 5, 7: 6}


def test_a_car_in_the_next_lane_hardly_leads_and_one_two_lanes_away_never():
    near = Following().pairs(table([(0, 0), (15, 3.5)], 0.0))
    assert near.rate.max(initial=0) < 0.02 * Following().rate
    assert len(Following().pairs(table([(0, 0), (15, 7.0)], 0.0)).target) == 0


def test_nobody_follows_oncoming_crossing_or_distant_traffic():
    oncoming = table([(0, 0), (15, 0)], [0.0, np.pi])
    crossing = table([(0, 0), (15, 0)], [0.0, np.pi / 2])
    distant = table([(0, 0), (41, 0)], 0.0)
    for nodes in (oncoming, crossing, distant):
        assert len(Following().pairs(nodes).target) == 0


def test_only_the_named_classes_follow():
    nodes = table(*straight(3), label=["car", "pedestrian", "truck"])
    assert leaders(Following().pairs(nodes)) == {2: 0}
    assert leaders(Following(classes=("pedestrian", "truck")).pairs(nodes)) == {2: 1}
    assert len(Following(classes=()).pairs(nodes).target) == 0


def test_the_rate_falls_with_distance_offset_and_turn():
    def rate(x, y, heading):
        return float(Following().pairs(table([(0, 0), (x, y)], [0.0, heading])).rate.max(initial=0))

    rates = [rate(10, 0, 0), rate(20, 0, 0), rate(20, 1, 0), rate(20, 1, -0.3)]
    assert rates == sorted(rates, reverse=True)
    assert rate(20, 20 * np.tan(0.15), 0.3) == pytest.approx(np.exp(-20 / 20 - (0.3 / 0.4) ** 2 / 2))


# neighbours


@given(seeds)
def test_neighbours_are_pulled_at_the_rate_of_the_kernels(seed):
    rule = Neighbours(max_degree=100)
    nodes = random_traffic(np.random.default_rng(seed))
    expected = {}
    for i in range(len(nodes)):
        for j in range(len(nodes)):
            apart = np.linalg.norm(nodes.position[i] - nodes.position[j])
            slow = min(np.linalg.norm(nodes.velocity[k]) for k in (i, j)) < 1.0
            if i == j or apart > 20.0 or slow:
                continue
            turn = nodes.heading[i] - nodes.heading[j]
            difference = np.linalg.norm(nodes.velocity[i] - nodes.velocity[j])
            squares = (apart / 8.0) ** 2 + (turn / 0.4) ** 2 + (difference / 3.0) ** 2
            expected.setdefault(i, {})[j] = pytest.approx(0.3 * np.exp(-squares / 2))
    assert edges(rule.pairs(nodes)) == expected


def test_headings_are_compared_across_the_seam():
    nodes = table([(0, 0), (5, 0)], [np.pi - 0.05, -np.pi + 0.05])
    assert Neighbours(speed_scale=np.inf).pairs(nodes).rate == pytest.approx(
        0.3 * np.exp(-((5 / 8) ** 2 + (0.1 / 0.4) ** 2) / 2)
    )


@given(seeds, st.integers(0, 5))
def test_at_most_the_strongest_edges_are_kept(seed, degree):
    nodes = random_traffic(np.random.default_rng(seed))
    every = edges(Neighbours(max_degree=100).pairs(nodes))
    kept = edges(Neighbours(max_degree=degree).pairs(nodes))
    for target, sources in every.items():
        strongest = sorted(sources.values(), reverse=True)[:degree]
        assert sorted(kept.get(target, {}).values(), reverse=True) == strongest
        assert kept.get(target, {}).items() <= sources.items()


@given(seeds, st.floats(-7, 7), st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)))
def test_rules_know_no_place_and_no_direction(seed, turn, shift):
    nodes = random_traffic(np.random.default_rng(seed), 12)
    R = yaw_transform(yaw=turn)[:2, :2]
    there = table(nodes.position @ R.T + np.array(shift), nodes.heading + turn, np.hypot(*nodes.velocity.T))
    for rule in (Neighbours(), Following()):
        here, moved = edges(rule.pairs(nodes)), edges(rule.pairs(there))
        assert here.keys() == moved.keys()
        for target, sources in here.items():
            assert moved[target] == {j: pytest.approx(rate, rel=1e-6) for j, rate in sources.items()}


@given(seeds)
def test_the_order_of_the_nodes_does_not_matter_to_rules(seed):
    rng = np.random.default_rng(seed)
    nodes = random_traffic(rng, 12)
    order = rng.permutation(12)
    permuted = table(nodes.position[order], nodes.heading[order], np.hypot(*nodes.velocity[order].T))
    for rule in (Neighbours(), Following()):
        renamed = {
            order[i]: {order[j]: pytest.approx(rate) for j, rate in sources.items()}
            for i, sources in edges(rule.pairs(permuted)).items()
        }
        assert edges(rule.pairs(nodes)) == renamed


def test_who_leads_may_be_those_that_move_or_those_that_stand():
    """Before a car stands a parked one, and before that drives another."""
    nodes = table(*straight(3))
    nodes = replace(nodes, has_moved=np.array([True, False, True]))
    assert leaders(Following().pairs(nodes)) == {2: 1}
    assert leaders(Following(leaders="moving").pairs(nodes)) == {}
    assert leaders(Following(leaders="moving").pairs(replace(nodes, has_moved=np.ones(3, dtype=bool)))) == {1: 0, 2: 1}
    assert leaders(Following(leaders="stationary").pairs(nodes)) == {2: 1}
    with pytest.raises(InputError, match="leaders: expected one of any, moving, stationary"):
        Following(leaders="parked")


@pytest.mark.parametrize("exists", [1.0, 0.4])
@pytest.mark.parametrize("leading", ["moving", "stationary"])
def test_rates_are_continuous_in_whether_a_vehicle_between_moves(leading, exists):
    nodes, rule = replace(table(*straight(3)), existence=np.array([1.0, exists, 1.0])), Following(leaders=leading)

    def led(moved):
        there = np.array([leading == "moving", moved, True], dtype=float)
        found = edges(rule.pairs(replace(nodes, has_moved=there))).get(2, {})
        return [found.get(source, 0.0) for source in (0, 1)]

    certain = 0.0 if leading == "moving" else 1.0
    assert led(certain) == pytest.approx(led(abs(certain - 1e-9)), abs=1e-8)
    assert led(certain)[0] == pytest.approx(led(1 - certain)[0]), "who leads from beyond depends on its existence alone"
    assert (led(certain)[0] == 0) == (exists == 1)

"""Rules of edges: who interacts with whom. Edge rules: who is coupled with whom, and how strongly."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg import ConstantVelocity, InputError, NodeType
from saga_fg.conformance.programs import BUS, CAR, CONE
from saga_fg.kernels.edges import pairs_ahead
from saga_fg.model.edge_rules import SPREAD, UNSEEN_ACCELERATION, Following, Neighbours, Pairs, traffic_rules
from saga_fg.model.graph_building import build_graph
from saga_fg.model.interactions import SHARP, CarFollowing, Paths, SharedVelocity
from saga_fg.model.nonlinear_interactions import IntelligentDriver, SmoothDriver
from saga_fg.numerics.geometry import Polylines
from tests.saga_fg.model.drawn_traffic import bend, edges, joined, leaders, random_traffic, straight, table, with_path

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


def test_leaders_are_the_nearest_that_exist_and_clutter_pulls_at_nobody():
    nodes = table([[0.0, 0.0], [3.0, 0.0], [0.0, 3.0]], 0.0)
    unsure = replace(nodes, existence=np.array([1.0, 0.25, 0.0]))
    full, weighted = (build_graph(each, [Neighbours()]).edges[0] for each in (nodes, unsure))
    of = {(i, j): rate for i, j, rate in zip(full.target, full.source, full.rate, strict=True)}
    assert 2 not in weighted.source
    for i, j, rate in zip(weighted.target, weighted.source, weighted.rate, strict=True):
        assert rate == pytest.approx(of[i, j] * unsure.existence[j])
    nodes = table(*straight(4, gap=8.0))  # 3 behind 2 behind 1 behind 0
    rule = Following(gap_scale=np.inf)
    r = np.array([0.9, 0.6, 0.2, 1.0])
    graph = build_graph(replace(nodes, existence=r), [rule])
    rates = edges(Pairs(graph.edges[0].target, graph.edges[0].source, graph.edges[0].rate))
    assert rates[3] == pytest.approx({2: rule.rate * 0.2, 1: rule.rate * 0.8 * 0.6, 0: rule.rate * 0.8 * 0.4 * 0.9})
    assert rates[1] == pytest.approx({0: rule.rate * 0.9})
    assert sum(rates[3].values()) == pytest.approx(rule.rate * (1 - 0.1 * 0.4 * 0.8))


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


@pytest.mark.parametrize(
    "road", [straight, lambda n, *where: bend(n, 80.0, *where), lambda n, *where: bend(n, -60.0, *where)]
)
def test_a_leader_is_taken_from_the_own_lane_though_another_car_is_nearer(road):
    lane, gap = 3.5, 20.0
    nodes = table(*joined(road(4, gap), road(4, gap, -lane, 8.0)))
    found = leaders(Following().pairs(nodes))
    assert {k: found[k] for k in (1, 2, 3)} == {1: 0, 2: 1, 3: 2}
    assert {k: found[k] for k in (5, 6, 7)} == {5: 4, 6: 5, 7: 6}


def test_nobody_follows_who_is_in_another_lane_class_or_direction():
    near = Following().pairs(table([(0, 0), (15, 3.5)], 0.0))
    assert near.rate.max(initial=0) < 0.02 * Following().rate
    assert len(Following().pairs(table([(0, 0), (15, 7.0)], 0.0)).target) == 0
    oncoming = table([(0, 0), (15, 0)], [0.0, np.pi])
    crossing = table([(0, 0), (15, 0)], [0.0, np.pi / 2])
    distant = table([(0, 0), (41, 0)], 0.0)
    for nodes in (oncoming, crossing, distant):
        assert len(Following().pairs(nodes).target) == 0
    nodes = table(*straight(3), label=["car", "pedestrian", "truck"])
    assert leaders(Following().pairs(nodes)) == {2: 0}
    assert leaders(Following(classes=("pedestrian", "truck")).pairs(nodes)) == {2: 1}
    assert len(Following(classes=()).pairs(nodes).target) == 0


def test_the_rate_falls_with_distance_offset_and_turn_across_the_seam():
    def rate(x, y, heading):
        return float(Following().pairs(table([(0, 0), (x, y)], [0.0, heading])).rate.max(initial=0))

    rates = [rate(10, 0, 0), rate(20, 0, 0), rate(20, 1, 0), rate(20, 1, -0.3)]
    assert rates == sorted(rates, reverse=True)
    assert rate(20, 20 * np.tan(0.15), 0.3) == pytest.approx(np.exp(-20 / 20 - (0.3 / 0.4) ** 2 / 2))
    nodes = table([(0, 0), (5, 0)], [np.pi - 0.05, -np.pi + 0.05])
    assert Neighbours(speed_scale=np.inf).pairs(nodes).rate == pytest.approx(
        0.3 * np.exp(-((5 / 8) ** 2 + (0.1 / 0.4) ** 2) / 2)
    )


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


@given(seeds, st.integers(0, 5))
def test_at_most_the_strongest_edges_are_kept(seed, degree):
    nodes = random_traffic(np.random.default_rng(seed))
    every = edges(Neighbours(max_degree=100).pairs(nodes))
    kept = edges(Neighbours(max_degree=degree).pairs(nodes))
    for target, sources in every.items():
        strongest = sorted(sources.values(), reverse=True)[:degree]
        assert sorted(kept.get(target, {}).values(), reverse=True) == strongest
        assert kept.get(target, {}).items() <= sources.items()


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


# From edge rules, shipped and of users, to a graph


class Ring:
    """A user's rule: everybody is pulled by the next one, and the last by the first."""

    interaction = SharedVelocity()

    def __init__(self, rate=0.5):
        self.rate = rate

    def pairs(self, nodes):
        n = len(nodes)
        return Pairs(np.arange(n), (np.arange(n) + 1) % n, np.full(n, self.rate))


class Fixed:
    interaction = SharedVelocity()

    def __init__(self, target, source, rate):
        self.chosen = (target, source, rate)

    def pairs(self, nodes):
        return self.chosen


def test_a_graph_of_several_rules_groups_edges_by_the_types_of_their_ends():
    nodes = table(*straight(4), types=(CAR, BUS, BUS, CAR))
    graph = build_graph(nodes, (Following(), Ring()))
    assert graph.nodes.tolist() == [100, 101, 102, 103]
    assert graph.edge_count == 3 + 4
    for group in graph.edges:
        assert len({(graph.types[i], graph.types[j]) for i, j in zip(group.target, group.source, strict=True)}) == 1
        assert group.interaction in ("CarFollowing", "SharedVelocity")
        following = group.interaction == "CarFollowing"
        law = CarFollowing() if following else SharedVelocity()
        assert np.array_equal(group.A_other, law.triples(nodes, group.target, group.source).A_other)


@given(seeds)
def test_rules_see_the_nodes_that_interact_alone(seed):
    rng = np.random.default_rng(seed)
    nodes, rules = random_traffic(rng), (Following(), Neighbours(), Following(SmoothDriver()))
    nodes = replace(nodes, outline={3: np.zeros((2, 2)), 7: np.ones((2, 2))}, unseen=rng.uniform(size=len(nodes)))
    interacting = rng.random(len(nodes)) < 0.6
    some = nodes.select(np.flatnonzero(interacting))
    assert some.id[list(some.outline)].tolist() == nodes.id[[k for k in (3, 7) if interacting[k]]].tolist()
    whole = build_graph(nodes, rules, explained_noise=1.0, interacting=interacting)
    part = build_graph(some, rules, explained_noise=1.0)
    assert whole.nodes.tolist() == nodes.id.tolist()
    assert (whole.diffusion_scale[~interacting] == 1).all()
    assert np.array_equal(whole.diffusion_scale[interacting], part.diffusion_scale)
    for ours, theirs in zip((*whole.edges, *whole.nonlinear), (*part.edges, *part.nonlinear), strict=True):
        for end in ("target", "source"):
            assert whole.nodes[getattr(ours, end)].tolist() == part.nodes[getattr(theirs, end)].tolist()
        assert vars(ours)["rate"].tolist() == vars(theirs)["rate"].tolist()


def test_weak_edges_and_edges_between_types_that_do_not_fit_are_left_out():
    nodes = table(*straight(3))
    assert build_graph(nodes, (Ring(rate=1e-4),)).edge_count == 0
    assert build_graph(nodes, (Ring(rate=1e-4),), min_rate=0).edge_count == 3
    mixed = table(*straight(3), types=(CAR, CONE, CAR))
    graph = build_graph(mixed, (Ring(),))
    assert [(g.target.tolist(), g.source.tolist()) for g in graph.edges] == [([2], [0])]


def test_what_interactions_explain_is_noise_no_more():
    nodes = table(*straight(3))
    plain = build_graph(nodes, (Following(), Ring(rate=0.5)))
    assert plain.diffusion_scale.tolist() == [1.0, 1.0, 1.0]
    explained = build_graph(nodes, (Following(), Ring(rate=0.5)), explained_noise=2.0)
    total = np.zeros(3)
    for group in plain.edges:
        np.add.at(total, group.target, group.rate)
    assert explained.diffusion_scale == pytest.approx(np.exp(-2.0 * total))
    assert build_graph(nodes, (), explained_noise=2.0).diffusion_scale.tolist() == [1.0, 1.0, 1.0]
    assert (build_graph(nodes, (Ring(rate=1e6),), explained_noise=1e6).diffusion_scale > 0).all()


def test_types_may_be_equal_and_rules_return_lists():
    again = NodeType("car", ConstantVelocity(acceleration_noise=1.5))
    graph = build_graph(table(*straight(3), types=(CAR, again, CAR)), (Following(),))
    assert graph.edge_count == 2
    assert build_graph(table(*straight(3)), (Fixed([0], [1], [0.5]),)).edge_count == 1


def test_a_users_rule_that_makes_no_sense_is_named(subtests):
    for chosen, message in [
        (([0, 3], [1, 1], [0.5, 0.5]), "edge rule Fixed: target: row 3 is outside 3 nodes"),
        (([0], [-1], [0.5]), "edge rule Fixed: source: row -1 is outside 3 nodes"),
        (([0], [1, 2], [0.5]), "edge rule Fixed: source: expected 1 entries, got 2"),
        (([0], [1], [np.nan]), r"edge rule Fixed: rate\[0\]: expected a finite number"),
        (([1], [1], [0.5]), "edges of SharedVelocity: node row 1 has an edge to itself"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            build_graph(table(*straight(3)), (Fixed(*chosen),))


# Leaders and gaps along the predicted path of a node


def round_the_corner():
    """A car before a left turn of 12 m radius, one round it, and one straight on."""
    places, headings = bend(8, 12.0, gap=-4.0)
    nodes = table([(0.0, 0.0), places[5], (20.0, 0.0)], [0.0, headings[5], 0.0])
    return nodes, places, headings


def test_the_leader_is_the_nearest_on_the_path_that_is_predicted():
    nodes, places, headings = round_the_corner()
    rule = Following(SharedVelocity(), gap_scale=np.inf)
    assert leaders(rule.pairs(nodes)) == {0: 2}
    assert leaders(rule.pairs(with_path(nodes, 0, places, headings))) == {0: 1}


@pytest.mark.parametrize("law", [CarFollowing(time_constant=2.0, headway=1.0), IntelligentDriver(headway=1.0)])
def test_laws_take_the_gap_along_the_path(law):
    """At the estimate, the acceleration is that behind a leader straight ahead, as far away as this one on the path."""
    nodes, places, headings = round_the_corner()
    nodes = with_path(nodes, 0, places, headings)
    ahead = nodes.along(np.array([0]), np.array([1])).ahead[0]
    assert ahead == pytest.approx(20.0, abs=0.5)

    def acceleration(nodes):
        triples = law.triples(nodes, np.array([0]), np.array([1]))
        x, other = (np.concatenate([nodes.position[k], nodes.velocity[k]]) for k in (0, 1))
        return (triples.A_self[0] @ x + triples.A_other[0] @ other + triples.b[0])[2:]

    straight_on = table([(0.0, 0.0), (ahead, 0.0), (60.0, 0.0)], 0.0)
    assert acceleration(nodes) == pytest.approx(acceleration(straight_on), abs=1e-9)
    step = 0.1 * np.array([[0.0, 0.0], [np.cos(headings[5]), np.sin(headings[5])], [0.0, 0.0]])
    further = replace(nodes, position=nodes.position + step)
    triples = law.triples(nodes, np.array([0]), np.array([1]))
    change = triples.A_other[0][2:, :2] @ step[1]
    if isinstance(law, CarFollowing):  # a gap closes in proportion, and the wanted one is the present one
        assert change == pytest.approx([0.1 / law.time_constant, 0.0], rel=0.1, abs=1e-3)
    else:
        assert change == pytest.approx(acceleration(further) - acceleration(nodes), rel=0.1, abs=1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_no_place_beside_a_path_is_left_out(seed):
    rng = np.random.default_rng(seed)
    bend = rng.normal(scale=rng.choice([0.01, 0.1, 0.5]), size=20)
    heading = rng.uniform(-3, 3) + np.concatenate([[0.0], np.cumsum(bend)])
    places = np.concatenate([np.zeros((1, 2)), np.cumsum(3 * np.stack([np.cos(heading), np.sin(heading)], 1)[1:], 0)])
    none = np.zeros((1, len(places)))
    paths = Paths(np.array([0]), places[None], heading[None], none, none, *np.zeros((2, 1)))
    others = rng.uniform(-70, 70, (2000, 2))
    at = Polylines.from_points(list(paths.position)).feet(np.zeros(2000, dtype=np.int64), others)
    beside = (at.s > 0) & (np.abs(at.e) < 3.6)
    path, able = np.full(2001, -1), np.ones(2001, dtype=bool)
    path[0], follows, every = 0, ~able, np.concatenate([places[:1], others])
    follows[0] = True
    cones = paths.cones(3.6)
    _, source = pairs_ahead(every, np.zeros(2001), follows, able, 200.0, 3.6, 0.1, path, places[:1], *cones, SHARP)
    kept = np.zeros(2000, dtype=bool)
    kept[source - 1] = True
    assert beside.any()
    assert kept[beside].all()
    if np.abs(np.cumsum(bend)).max() < 0.3:
        assert kept.mean() < 0.4

"""From edge rules, shipped and of users, to a graph."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg import ConstantVelocity, InputError, NodeType
from saga_fg.conformance.programs import BUS, CAR, CONE
from saga_fg.model.edge_rules import Following, Neighbours, Pairs
from saga_fg.model.graph_building import build_graph
from saga_fg.model.interactions import CarFollowing, SharedVelocity
from saga_fg.model.nonlinear_interactions import SmoothDriver
from tests.saga_fg.model.drawn_traffic import random_traffic, straight, table

seeds = st.integers(0, 2**32 - 1)


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


@pytest.mark.parametrize("n", [0, 1])
def test_too_few_nodes_for_an_edge(n):
    nodes = table(*straight(n))
    for rule in (Following(), Neighbours()):
        assert len(rule.pairs(nodes).target) == 0
    graph = build_graph(nodes, (Following(), Neighbours(), Ring()))
    assert (len(graph), graph.edge_count) == (n, 0)


def test_types_that_are_equal_but_not_the_same_object():
    again = NodeType("car", ConstantVelocity(acceleration_noise=1.5))
    graph = build_graph(table(*straight(3), types=(CAR, again, CAR)), (Following(),))
    assert graph.edge_count == 2


def test_a_users_rule_that_makes_no_sense_is_named(subtests):
    for chosen, message in [
        (([0, 3], [1, 1], [0.5, 0.5]), "edge rule Fixed: target: row 3 is outside 3 nodes"),
        (([0], [-1], [0.5]), "edge rule Fixed: source: row -1 is outside 3 nodes"),
        (([0], [1, 2], [0.5]), "edge rule Fixed: source: expected 1 entries, got 2"),
        (([0.0], [1], [0.5]), "edge rule Fixed: target: expected a list of integers"),
        (([0], [1], [np.nan]), r"edge rule Fixed: rate\[0\]: expected a finite number"),
        (([0], [1], [0.5, 0.5]), r"edge rule Fixed: rate: expected shape \(1,\)"),
        (([1], [1], [0.5]), "edges of SharedVelocity: node row 1 has an edge to itself"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            build_graph(table(*straight(3)), (Fixed(*chosen),))


def test_a_users_rule_may_return_plain_lists():
    assert build_graph(table(*straight(3)), (Fixed([0], [1], [0.5]),)).edge_count == 1

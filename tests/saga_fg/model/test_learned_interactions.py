"""The file of learned interactions, and the rules that may stand in it."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from saga_fg.model.edge_network import FEATURES, EdgeNetwork

from pipelines.configuration import read_settings, write_settings
from saga_fg import InputError
from saga_fg.learning import TEMPLATE
from saga_fg.model.edge_rules import Following, Neighbours
from saga_fg.model.interactions import CarFollowing, NodeTable, SharedCourse, SharedVelocity, velocity_triples
from saga_fg.model.learned_interactions import LearnedInteractions
from tests.saga_fg.random_graphs import CAR


def network(seed=0, hidden=4, **changes):
    rng = np.random.default_rng(seed)

    def rows(*shape):
        return tuple(map(tuple, rng.normal(size=shape).tolist()))

    return EdgeNetwork(
        edge_weights=rows(hidden, FEATURES),
        edge_bias=rows(1, hidden)[0],
        node_weights=rows(hidden, hidden),
        output_weights=rows(1, 2 * hidden)[0],
        output_bias=0.3,
        **changes,
    )


def scattered(seed, n=6):
    rng = np.random.default_rng(seed)
    velocity = rng.normal(0, 5, (n, 2))
    heading = np.arctan2(velocity[:, 1], velocity[:, 0])
    position = rng.uniform(-20, 20, (n, 2))
    return NodeTable(
        np.arange(n), np.full(n, "car"), (CAR,) * n, position, velocity, heading, np.full(n, 4.0), np.ones(n)
    )


def test_what_is_written_is_read_again():
    learned = LearnedInteractions(
        learned_from="two recordings",
        edges=(*TEMPLATE, network()),
        explained_noise=0.5,
        acceleration_noise={"car": 0.2, "default": 0.4},
    )
    assert read_settings(LearnedInteractions, write_settings(learned)) == learned


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("version: 2", "version: expected 1"),
        ("format: something", "format: expected one of"),
        ("acceleration_noise: {car: -1.0}", "acceleration_noise.car: expected a finite number > 0"),
        ("edges: [{kind: following, rate: 50.0}]", r"edges\[0\].rate: expected at most 20 1/s, got 50"),
        ("edges: [{kind: neighbours, rate: -1.0}]", "rate: expected a finite number >= 0"),
        (
            "edges: [{kind: neighbours, interaction: {kind: car_following, time_constant: 0.1}, rate: 5.0}]",
            r"edges\[0\]: expected stable steps, what two nodes .* grows by the factor",
        ),
        ("edges: [{kind: edge_network, edge_bias: [1.0]}]", "edge_weights: expected 1 x 12 finite numbers"),
    ],
)
def test_a_mistake_in_the_file_is_named(text, message):
    with pytest.raises(InputError, match=message):
        read_settings(LearnedInteractions, text, "mine.yaml")


def test_dynamics_that_run_away_are_refused():
    @dataclasses.dataclass(frozen=True)
    class Flight:
        """Nodes flee: the velocity grows."""

        needs = ((), ())

        def triples(self, nodes, target, source):
            return velocity_triples(nodes, target, source, by_velocity=np.eye(2))

    with pytest.raises(InputError, match=r"edges\[0\]: expected stable dynamics"):
        LearnedInteractions(edges=(Neighbours(Flight(), rate=1.0),))


@settings(max_examples=30)
@given(
    st.floats(0.001, 20),
    st.sampled_from([SharedVelocity(), SharedVelocity(True), SharedCourse()]),
    st.floats(0.5, 1e3) | st.just(math.inf),
)
def test_shipped_interactions_are_stable_at_every_rate(rate, interaction, tau):
    for rule in (Neighbours(interaction, rate=rate), Following(CarFollowing(tau), rate=rate)):
        LearnedInteractions(edges=(rule,))


@given(st.integers(0, 1000))
def test_rates_of_a_network_stay_in_their_range_and_see_no_frame(seed):
    rule, nodes = network(seed, max_rate=2.0), scattered(seed)
    pairs = rule.pairs(nodes)
    assert (pairs.rate >= 0).all()
    assert (pairs.rate <= 2.0).all()
    c, s = np.cos(1.0), np.sin(1.0)
    R = np.array([[c, -s], [s, c]])
    moved = dataclasses.replace(
        nodes, position=nodes.position @ R.T + 100.0, velocity=nodes.velocity @ R.T, heading=nodes.heading + 1.0
    )
    again = rule.pairs(moved)
    rates = {(i, j): r for i, j, r in zip(*map(np.ndarray.tolist, pairs), strict=True)}
    for i, j, r in zip(*map(np.ndarray.tolist, again), strict=True):
        assert rates[i, j] == pytest.approx(r, abs=1e-9)


def test_a_network_without_weights_has_no_edges():
    assert len(EdgeNetwork().pairs(scattered(0)).target) == 0

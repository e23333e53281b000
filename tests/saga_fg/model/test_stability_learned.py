"""The file of learned interactions, and the rules that may stand in it."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.configuration import read_settings, write_settings
from saga_fg import InputError
from saga_fg.learning import TEMPLATE
from saga_fg.model.edge_rules import Following, Neighbours
from saga_fg.model.interactions import CarFollowing, SharedVelocity, velocity_triples
from saga_fg.model.stability import LearnedInteractions


def test_what_is_written_is_read_again():
    learned = LearnedInteractions(
        learned_from="two recordings",
        edges=TEMPLATE,
        explained_noise=0.5,
    )
    assert read_settings(LearnedInteractions, write_settings(learned)) == learned


def test_a_mistake_in_the_file_is_named(subtests):
    for text, message in [
        ("version: 2", "version: expected 1"),
        ("format: something", "format: expected one of"),
        ("edges: [{kind: following, rate: 50.0}]", r"edges\[0\].rate: expected at most 20 1/s, got 50"),
        ("edges: [{kind: neighbours, rate: -1.0}]", "rate: expected a finite number >= 0"),
        (
            "edges: [{kind: neighbours, interaction: {kind: car_following, time_constant: 0.1}, rate: 5.0}]",
            r"edges\[0\]: expected stable steps, what two nodes .* grows by the factor",
        ),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
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
    st.sampled_from([SharedVelocity(), SharedVelocity(True)]),
    st.floats(0.5, 1e3) | st.just(math.inf),
)
def test_shipped_interactions_are_stable_at_every_rate(rate, interaction, tau):
    for rule in (Neighbours(interaction, rate=rate), Following(CarFollowing(tau), rate=rate)):
        LearnedInteractions(edges=(rule,))

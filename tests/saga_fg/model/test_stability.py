"""Edge rules that would drive objects apart are refused, alone and together."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.config import TrackConfig
from pipelines.configuration import read_settings
from saga_fg import InputError
from saga_fg.model.discretisation import discretise
from saga_fg.model.edge_rules import Following, Neighbours
from saga_fg.model.graph_building import build_graph
from saga_fg.model.interactions import CarFollowing, NodeTable, SharedVelocity
from saga_fg.model.motion import ConstantVelocity, NodeType
from saga_fg.model.stability import highest_rate, require_stable
from saga_fg.tracking import TrackerSettings

CONVOY = CarFollowing(time_constant=1.0)


def test_neighbours_count_as_often_as_a_node_may_have_them():
    rule = Neighbours(CONVOY, rate=0.3, max_degree=1)
    require_stable([rule])
    with pytest.raises(InputError, match=r"edges\[0\]: expected stable steps, .* up to 1\.8 1/s, the highest sum"):
        require_stable([dataclasses.replace(rule, max_degree=6)])


def test_rules_that_are_stable_one_by_one_are_tried_together():
    rule = Neighbours(CONVOY, rate=1.0, max_degree=1)
    require_stable([rule])
    with pytest.raises(InputError, match=r"edges\[0\], edges\[1\]: expected stable steps, .* up to 2 1/s"):
        require_stable([rule, rule])


def test_rules_that_never_meet_are_not_tried_together():
    one = Neighbours(CONVOY, rate=1.0, max_degree=1)
    apart = [dataclasses.replace(one, classes=(name,)) for name in ("car", "bus")]
    require_stable(apart)


def test_the_configuration_names_the_rules():
    text = "tracker: {{edges: [{{kind: attached}}], max_step: {step}}}"
    assert read_settings(TrackConfig, text.format(step=0.25), "mine.yaml").tracker.max_step == 0.25
    with pytest.raises(InputError, match=r"mine\.yaml: tracker: edges\[0\]: expected stable steps"):
        read_settings(TrackConfig, text.format(step=1.0), "mine.yaml")
    with pytest.raises(InputError, match=r"edges\[0\], edges\[1\]: expected stable"):
        TrackerSettings(edges=(Neighbours(CONVOY, rate=0.25), Neighbours(CONVOY, rate=0.25)))


@settings(max_examples=15)
@given(
    st.integers(0, 1000),
    st.floats(0.01, 3.0),
    st.floats(0.5, 10.0) | st.just(math.inf),
    st.sampled_from([0.1, 0.5, 1.0]),
)
def test_what_is_let_pass_does_not_grow_on_scattered_nodes(seed, rate, tau, dt):
    """Crowds of nodes, each with many neighbours: not only the pairs that were tried."""
    rules = (Neighbours(CarFollowing(tau), rate=rate), Neighbours(SharedVelocity(), rate=rate))
    try:
        require_stable(rules)
    except InputError:
        return
    rng = np.random.default_rng(seed)
    n = 8
    heading = rng.uniform(-0.4, 0.4, n)
    velocity = 5 * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    car = NodeType("car", ConstantVelocity(1.0))
    position = rng.uniform(0, 12, (n, 2))
    names = np.full(n, "car")
    nodes = NodeTable(np.arange(n), names, (car,) * n, position, velocity, heading, np.full(n, 4.0), np.ones(n))
    F = discretise(build_graph(nodes, rules), dt).F_matrix.toarray()
    assert np.abs(np.linalg.eigvals(F)).max() < 1 + 1e-3


def test_highest_rates_are_sums_over_the_edges_of_a_node():
    assert highest_rate(Neighbours(rate=0.5, max_degree=3)) == 1.5
    assert highest_rate(Following(rate=0.7)) == 0.7

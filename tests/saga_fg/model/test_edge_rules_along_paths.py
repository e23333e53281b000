"""Leaders and gaps along the predicted path of a node."""

from dataclasses import replace

import numpy as np
import pytest

from saga_fg.kernels.edges import pairs_ahead
from saga_fg.model.edge_rules import Following
from saga_fg.model.interactions import SHARP, CarFollowing, Paths, SharedVelocity
from saga_fg.model.nonlinear_interactions import IntelligentDriver
from saga_fg.numerics.geometry import Polylines
from tests.saga_fg.model.drawn_traffic import bend, edges, leaders, random_traffic, table, with_path


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


def test_a_straight_path_is_no_path():
    rng = np.random.default_rng(3)
    for _ in range(10):
        nodes = random_traffic(rng)
        nodes = replace(nodes, heading=np.zeros(len(nodes)))
        on = nodes.position[4] + np.arange(0.0, 60.0, 3.0)[:, None] * np.array([1.0, 0.0])
        rule = Following(SharedVelocity())
        assert edges(rule.pairs(nodes)).get(4, {}) == pytest.approx(
            edges(rule.pairs(with_path(nodes, 4, on, np.zeros(20)))).get(4, {})
        )


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

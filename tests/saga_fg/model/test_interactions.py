"""Interaction functions: their triples are the written law, and the law knows no place and no direction."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg.conformance.programs import BUS, CAR, CONE, MOVING, POLE, TRAM, node_table
from saga_fg.model.interactions import CarFollowing, NodeTable, SharedVelocity, applies
from saga_fg.numerics.geometry import yaw_transform

seeds = st.integers(0, 2**32 - 1)
pairs_of_types = st.tuples(st.sampled_from(MOVING), st.sampled_from(MOVING))
INTERACTIONS = [
    SharedVelocity(),
    SharedVelocity(along_heading=True),
    CarFollowing(),
    CarFollowing(headway=1.2, time_constant=2.5),
]


def unit(heading):
    return np.array([np.cos(heading), np.sin(heading)])


def acceleration(interaction, nodes, i, j, p_i, v_i, p_j, v_j):
    """The laws of the module docstring, word by word; the table gives headings, lengths and present estimates."""
    u_i, u_j = unit(nodes.heading[i]), unit(nodes.heading[j])
    if isinstance(interaction, SharedVelocity):
        turn = nodes.heading[i] - nodes.heading[j] if interaction.along_heading else 0.0
        return yaw_transform(yaw=turn)[:2, :2] @ v_j - v_i
    gap = u_i @ (nodes.position[j] - nodes.position[i]) - interaction.headway * (u_i @ nodes.velocity[i])
    excess = u_i @ (p_j - p_i) - gap - interaction.headway * (u_i @ v_i)
    return u_i * (u_j @ v_j - u_i @ v_i + excess / interaction.time_constant)


def two_nodes(rng, types):
    nodes = node_table(rng, types)
    return nodes, np.array([0]), np.array([1])


def state(node_type, p, v):
    x = np.zeros(node_type.dim)
    x[node_type.index(("x", "y"))], x[node_type.index(("vx", "vy"))] = p, v
    return x


@pytest.mark.parametrize("interaction", INTERACTIONS, ids=repr)
@given(types=pairs_of_types, seed=seeds)
def test_triples_are_the_derivatives_of_the_law(interaction, types, seed):
    """Finite differences of the law, which is linear in the states, give A_self and A_other; its value at zero, b."""
    rng = np.random.default_rng(seed)
    nodes, target, source = two_nodes(rng, types)
    A_self, A_other, b = (part[0] for part in interaction.triples(nodes, target, source))

    def rate_of_change(x_i, x_j):
        p_i, v_i = (x_i[types[0].index(names)] for names in (("x", "y"), ("vx", "vy")))
        p_j, v_j = (x_j[types[1].index(names)] for names in (("x", "y"), ("vx", "vy")))
        change = np.zeros(types[0].dim)
        change[types[0].index(("vx", "vy"))] = acceleration(interaction, nodes, 0, 1, p_i, v_i, p_j, v_j)
        if isinstance(interaction, SharedVelocity) and types[0].has(("ax", "ay")):
            at = types[0].index(("ax", "ay"))
            change[at] = -x_i[at]
        return change

    zero_i, zero_j = np.zeros(types[0].dim), np.zeros(types[1].dim)
    difference = [(rate_of_change(e, zero_j) - rate_of_change(-e, zero_j)) / 2 for e in np.eye(types[0].dim)]
    assert np.allclose(A_self, np.transpose(difference), atol=1e-12)
    difference = [(rate_of_change(zero_i, e) - rate_of_change(zero_i, -e)) / 2 for e in np.eye(types[1].dim)]
    assert np.allclose(A_other, np.transpose(difference), atol=1e-12)
    assert np.allclose(b, rate_of_change(zero_i, zero_j), atol=1e-12)


def moved(nodes, turn, shift):
    R = yaw_transform(yaw=turn)[:2, :2]
    return NodeTable(
        nodes.id,
        nodes.label,
        nodes.types,
        nodes.position @ R.T + shift,
        nodes.velocity @ R.T,
        nodes.heading + turn,
        nodes.length,
        nodes.velocity_variance,
    ), R


@pytest.mark.parametrize("interaction", INTERACTIONS, ids=repr)
@given(
    types=pairs_of_types, seed=seeds, turn=st.floats(-7, 7), shift=st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3))
)
def test_the_law_is_the_same_at_every_place_and_in_every_direction(interaction, types, seed, turn, shift):
    rng = np.random.default_rng(seed)
    nodes, target, source = two_nodes(rng, types)
    there, R = moved(nodes, turn, np.array(shift))
    p, v = rng.normal(size=(2, 2)) * 30, rng.normal(size=(2, 2)) * 10
    felt = []
    for table, positions, velocities in ((nodes, p, v), (there, p @ R.T + np.array(shift), v @ R.T)):
        A_self, A_other, b = (part[0] for part in interaction.triples(table, target, source))
        x_i, x_j = (state(t, positions[k], velocities[k]) for k, t in enumerate(types))
        felt.append((A_self @ x_i + A_other @ x_j + b)[types[0].index(("vx", "vy"))])
    assert np.allclose(R @ felt[0], felt[1], atol=1e-8)


@pytest.mark.parametrize("types", [(CAR, CAR), (BUS, TRAM), (TRAM, CAR)], ids=lambda t: f"{t[0].name}-{t[1].name}")
def test_a_formation_feels_nothing(types):
    """At the present estimate, at equal speeds along the headings, nothing has to change."""
    nodes = node_table(np.random.default_rng(2), types)
    along = np.stack([8.0 * unit(heading) for heading in nodes.heading])
    nodes = replace(nodes, velocity=along)
    for interaction in (CarFollowing(), CarFollowing(headway=1.5), SharedVelocity(along_heading=True)):
        A_self, A_other, b = (part[0] for part in interaction.triples(nodes, np.array([0]), np.array([1])))
        x_i, x_j = (state(t, nodes.position[k], nodes.velocity[k]) for k, t in enumerate(types))
        assert np.allclose(A_self @ x_i + A_other @ x_j + b, 0, atol=1e-12)


def test_a_follower_brakes_when_too_close_and_when_its_leader_brakes():
    nodes = NodeTable(
        np.array([1, 2]),
        np.array(["car", "car"]),
        (CAR, CAR),
        np.array([[0.0, 0.0], [10.0, 0.0]]),
        np.array([[5.0, 0.0], [5.0, 0.0]]),
        np.zeros(2),
        np.full(2, 4.0),
        np.ones(2),
    )
    triples = CarFollowing().triples(nodes, np.array([0]), np.array([1]))
    A_self, A_other, b = (part[0] for part in triples)
    closer = A_self @ [3.0, 0.0, 5.0, 0.0] + A_other @ [10.0, 0.0, 5.0, 0.0] + b
    leader_brakes = A_self @ [0.0, 0.0, 5.0, 0.0] + A_other @ [10.0, 0.0, 2.0, 0.0] + b
    assert closer[2] == pytest.approx(-3.0 / 4.0)
    assert leader_brakes[2] == pytest.approx(-3.0)
    assert closer[3] == leader_brakes[3] == 0.0


def test_many_edges_are_the_edges_one_by_one():
    nodes = node_table(np.random.default_rng(8), (BUS,) * 5)
    target, source = np.array([0, 1, 4, 2]), np.array([1, 0, 2, 3])
    for interaction in INTERACTIONS:
        together = interaction.triples(nodes, target, source)  # type: ignore[attr-defined]
        for k in range(4):
            alone = interaction.triples(nodes, target[k : k + 1], source[k : k + 1])  # type: ignore[attr-defined]
            for a, b in zip(together, alone, strict=True):
                assert np.array_equal(a[k], b[0])


def test_interactions_say_which_types_they_act_on():
    for interaction in INTERACTIONS:
        assert all(applies(interaction.needs, a, b) for a in MOVING for b in MOVING)  # type: ignore[attr-defined]
        assert not any(
            applies(interaction.needs, a, b) or applies(interaction.needs, b, a)  # type: ignore[attr-defined]
            for a in MOVING
            for b in (CONE, POLE)  # type: ignore[attr-defined]
        )


def test_shared_velocity_takes_the_acceleration_of_the_follower_not_that_of_the_leader():
    nodes = node_table(np.random.default_rng(1), (TRAM, TRAM))
    triples = SharedVelocity().triples(nodes, np.array([0]), np.array([1]))
    at = TRAM.index(("ax", "ay"))
    assert triples.A_self[0][np.ix_(at, at)] == pytest.approx(-np.eye(2))
    assert not triples.A_other[0][at].any()

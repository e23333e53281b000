"""Interactions, linear and nonlinear."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from saga_fg import InputError
from saga_fg.conformance.programs import BUS, MOVING, node_table
from saga_fg.model import nonlinear_interactions
from saga_fg.model.edge_rules import Following
from saga_fg.model.graph_building import require_stable
from saga_fg.model.interactions import CarFollowing, SharedVelocity
from saga_fg.model.nonlinear_interactions import (
    HIDDEN_VEHICLE_GAP,
    MAX_DECELERATION,
    STOP_TIME,
    IntelligentDriver,
    SmoothDriver,
    SocialForce,
    smooth_acceleration,
)
from saga_fg.numerics.geometry import yaw_transform
from tests.saga_fg.road_scenes import table
from tests.saga_fg.sampled_traffic import Interaction

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


def test_many_edges_are_the_edges_one_by_one():
    nodes = node_table(np.random.default_rng(8), (BUS,) * 5)
    target, source = np.array([0, 1, 4, 2]), np.array([1, 0, 2, 3])
    for interaction in INTERACTIONS:
        together = interaction.triples(nodes, target, source)  # type: ignore[attr-defined]
        for k in range(4):
            alone = interaction.triples(nodes, target[k : k + 1], source[k : k + 1])  # type: ignore[attr-defined]
            for a, b in zip(together, alone, strict=True):
                assert np.array_equal(a[k], b[0])


# Interaction functions of the running graph: what drivers and pedestrians do


def test_gaps_close_up_to_what_is_wanted_and_nobody_drives_backwards():
    driver = IntelligentDriver()
    v, s, w = np.array([8.0, 10.0, 6.0]), np.array([15.0, 30.0, 20.0]), np.array([8.0, 9.0, 6.5])
    np.testing.assert_allclose(smooth_acceleration(driver, v, s, w).value, driver.alone(v, s, w).value, atol=0.02)
    assert smooth_acceleration(driver, np.array(15.0), np.array(0.1), np.array(0.0)).value > -MAX_DECELERATION - 0.01
    law, x = Interaction(SmoothDriver()), np.array([0.0, 0.0, 3.0, 0.0])
    for _ in range(100):
        x = law.predict(x, [np.array([5.5, 0.0, 0.0, 0.0])], 0.1)
    assert 0.0 < x[0] < 2.0
    assert abs(x[2]) < 0.05
    law, leader = Interaction(SmoothDriver()), np.array([100.0, 0.0, 8.0, 0.0])
    x = np.array([20.0, 0.0, 8.0, 0.0])
    for _ in range(1200):
        x, leader = law.predict(x, [leader], 0.1), leader + np.array([0.8, 0.0, 0.0, 0.0])
    assert x[2] == pytest.approx(8.0, abs=0.05)
    assert 8.0 < leader[0] - x[0] - float(SmoothDriver.alone) < 14.0
    for gap in (2.5, 5.0, 30.0):
        assert value(DRIVER.following, 0, gap, 0) == 0
        assert value(DRIVER.stopping, 0, gap) == 0
    assert value(DRIVER.following, 0, 5.0, 2.0) > 0.5


PIECES = np.array([[-5.0, 0.0, 0.0, 1.0], [0.0, 1.0, 4.0, 0.0]])  # a wall with a corner


def test_a_wall_pushes_along_its_normal_and_from_its_end(monkeypatch):
    monkeypatch.setattr(nonlinear_interactions, "FALLOFF", 5.0)
    at, still = np.array([[-2.5, 2.5, 0, 0], [7.0, -4.0, 0, 0]]), np.zeros((2, 4))
    a = SocialForce().accelerations(at, still, np.stack([PIECES, PIECES])).value
    normal = np.array([-1.0, 5.0]) / np.sqrt(26)
    np.testing.assert_allclose(a[0] / np.hypot(*a[0]), normal, atol=1e-7)  # the farther piece acts by e^-17
    np.testing.assert_allclose(a[1] / np.hypot(*a[1]), [0.6, -0.8], atol=1e-12)
    assert np.hypot(*a[1]) == pytest.approx(2.0 * np.exp((0.6 - 5.0) / 5.0))


# The Intelligent Driver Model as an interaction: its law, its derivatives, and what drivers do not do

DRIVER = IntelligentDriver(free_speed=14.0, headway=1.2, acceleration=1.5, deceleration=2.0)
speeds, gaps = st.floats(0, 16), st.floats(0.6, 80)


def value(function, *arguments):
    return float(function(*(np.array([float(x)]) for x in arguments)).value[0])


def derivatives(found):
    return np.array([float(part[0]) for part in found[1:]])


@given(v=speeds, s=gaps, w=speeds)
def test_derivatives_are_those_of_the_law_and_drivers_brake_within_limits(v, s, w):
    found = DRIVER.following(*(np.array([x]) for x in (v, s, w)))
    eps = 1e-6
    steps = np.eye(3) * eps
    low, high = ([value(DRIVER.following, *(np.array([v, s, w]) + sign * e)) for e in steps] for sign in (-1, 1))
    centre = np.full(3, value(DRIVER.following, v, s, w))
    one_sided = np.stack([centre - low, high - centre]) / eps
    assume(np.allclose(*one_sided, atol=1e-3))  # not at a corner of the law
    assert np.allclose(derivatives(found), one_sided.mean(axis=0), atol=2e-3)
    braking = -value(DRIVER.alone, v, s, w)
    assert braking <= MAX_DECELERATION + 1e-9
    assert braking <= v / STOP_TIME + 1e-9


@given(v=st.floats(0.5, 13.5))
def test_in_equilibrium_nobody_accelerates(v):
    gap = (DRIVER.standstill_gap + v * DRIVER.headway) / math.sqrt(1 - (v / DRIVER.free_speed) ** 4)
    assert value(DRIVER.alone, v, gap, v) == pytest.approx(0, abs=1e-9)
    assert value(DRIVER.alone, v, gap - 0.5, v) < 0 < value(DRIVER.alone, v, gap + 0.5, v)


@given(v=speeds, w=speeds, s=st.floats(7, 80))
def test_nobody_speeds_up_into_a_gap_with_room_for_another(v, w, s):
    assert value(DRIVER.following, v, s, w) <= w - v + 1e-9
    assert value(DRIVER.stopping, v, s) <= 0
    close = HIDDEN_VEHICLE_GAP - 0.1
    assert value(DRIVER.following, v, close, w) == value(DRIVER.alone, v, close, w)


def test_neither_its_double_nor_a_trailer_counts_as_led():
    rows = [("car", 0, 0, 8, 0, 5), ("car", 2, 0, 8, 0, 5), ("car", 20, 0, 8, 0, 5)]
    led = Following(interaction=DRIVER, min_separation=0.8).pairs(table(rows))
    assert dict(zip(led.target.tolist(), led.source.tolist(), strict=True)) == {0: 2, 1: 2}
    # Its gap to its truck is none that a driver keeps.
    rows = [("truck", 0, 0, 8, 0, 8), ("trailer", -8.5, 0, 8, 0, 7), ("car", -25, 0, 8, 0, 5)]
    led = Following(interaction=DRIVER, towed=("trailer",)).pairs(table(rows))
    assert dict(zip(led.target.tolist(), led.source.tolist(), strict=True)) == {2: 1}


def test_the_law_is_stable_and_its_settings_are_checked():
    require_stable([Following(interaction=DRIVER, rate=1.0)])
    with pytest.raises(InputError, match="headway"):
        IntelligentDriver(headway=0.0)

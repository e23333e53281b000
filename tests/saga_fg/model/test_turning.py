"""Coordinated turn: exact discretisation, smooth where it goes straight."""

import numpy as np
import pytest
import scipy.integrate

from factors import Vector
from factors.manifolds import central_differences
from saga_fg import ConstantVelocity, NodeType, SceneGraph
from saga_fg.model.discretisation import discretise
from saga_fg.model.turning import CoordinatedTurn

TURN = CoordinatedTurn()
SMALL = (0.0, 0.0099, 0.0101, -2.0)


def states(last, seed=0):
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.normal(size=(6, 4)) * [50, 50, 9, 9], np.full((6, 1), last)], axis=1)


@pytest.mark.parametrize("last", [0.0, 0.001, -0.4, 0.9])
def test_the_flow_solves_its_differential_equation(last):
    x = states(last)[0]
    solved = scipy.integrate.solve_ivp(
        lambda t, y: [*y[2:4], *(y[4] * np.array([-y[3], y[2]])), 0.0],
        (0.0, 0.7),
        x,
        rtol=1e-12,
        atol=1e-12,
    )
    np.testing.assert_allclose(TURN.flow(x, 0.7), solved.y[:, -1], atol=1e-9)


@pytest.mark.parametrize("last", SMALL)
def test_jacobians_are_the_derivatives(last):
    x = states(last)
    (expected,) = central_differences(lambda y: TURN.flow(y, 0.3), [x], [Vector(x.shape[-1])])
    np.testing.assert_allclose(TURN.flow_jacobian(x, 0.3), expected, atol=2e-8)
    np.testing.assert_allclose(TURN.flow(TURN.flow(x, 0.1), 0.2), TURN.flow(x, 0.3), atol=1e-12)
    np.testing.assert_allclose(TURN.flow(TURN.flow(x, 0.3), -0.3), x, atol=1e-12)


def test_going_straight_is_constant_velocity_with_its_noise():
    turning, straight = NodeType("turning", TURN), NodeType("straight", ConstantVelocity(2.0))
    x = states(0.0)[0]
    (F,), (Q,) = ([b.values[0] for b in blocks] for blocks in _linear(straight))
    np.testing.assert_allclose(TURN.flow(x, 0.4)[:4], F @ x[:4], atol=1e-12)
    np.testing.assert_allclose(_linear(turning)[1][0].values[0][:4, :4], Q, atol=1e-12)
    assert turning.initial_deviation[4] < 1


def _linear(node_type):
    transition = discretise(SceneGraph.of([0], node_type), 0.4)
    return transition.F, transition.Q

"""Coordinated turn and bicycle: exact discretisation, smooth where they go straight."""

import numpy as np
import pytest
import scipy.integrate

from factors.manifolds import stacked_differences
from saga_fg import ConstantVelocity, InputError, NodeType, SceneGraph
from saga_fg.model.discretisation import discretise
from saga_fg.model.turning import Bicycle, CoordinatedTurn

TURNING = [CoordinatedTurn(), Bicycle(wheelbase=3.0)]
SMALL = (0.0, 1e-12, 1e-4, 0.0099, 0.0101, 0.3, -2.0, 7.0)


def states(last, seed=0):
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.normal(size=(6, 4)) * [50, 50, 9, 9], np.full((6, 1), last)], axis=1)


def turn_rate(motion, x):
    if isinstance(motion, CoordinatedTurn):
        return x[4]
    beta = np.arctan(np.tan(x[4]) / 2)
    return np.hypot(x[2], x[3]) * np.sin(beta) / (motion.wheelbase / 2)


@pytest.mark.parametrize("motion", TURNING, ids=["turn", "bicycle"])
@pytest.mark.parametrize("last", [0.0, 0.001, -0.4, 0.9])
def test_the_flow_solves_its_differential_equation(motion, last):
    x = states(last)[0]
    solved = scipy.integrate.solve_ivp(
        lambda t, y: [*y[2:4], *(turn_rate(motion, y) * np.array([-y[3], y[2]])), 0.0],
        (0.0, 0.7),
        x,
        rtol=1e-12,
        atol=1e-12,
    )
    np.testing.assert_allclose(motion.flow(x, 0.7), solved.y[:, -1], atol=1e-9)


@pytest.mark.parametrize("motion", TURNING, ids=["turn", "bicycle"])
@pytest.mark.parametrize("last", SMALL)
def test_jacobians_are_the_derivatives(motion, last):
    x = states(last)
    (expected,) = stacked_differences(lambda y: motion.flow(y, 0.3), [x])
    np.testing.assert_allclose(motion.flow_jacobian(x, 0.3), expected, atol=2e-8)
    np.testing.assert_allclose(motion.flow(motion.flow(x, 0.1), 0.2), motion.flow(x, 0.3), atol=1e-12)
    np.testing.assert_allclose(motion.flow(motion.flow(x, 0.3), -0.3), x, atol=1e-12)


def test_a_bicycle_that_stands_does_not_turn_and_has_a_jacobian():
    x = np.array([1.0, 2.0, 0.0, 0.0, 0.4])
    np.testing.assert_array_equal(Bicycle().flow(x, 0.5), x)
    np.testing.assert_allclose(Bicycle().flow_jacobian(x, 0.5), np.eye(5) + 0.5 * np.diag([1, 1, 0], k=2))


@pytest.mark.parametrize("motion", TURNING, ids=["turn", "bicycle"])
def test_going_straight_is_constant_velocity_with_its_noise(motion):
    turning, straight = NodeType("turning", motion), NodeType("straight", ConstantVelocity(2.0))
    x = states(0.0)[0]
    (F,), (Q,) = ([b.values[0] for b in blocks] for blocks in _linear(straight))
    np.testing.assert_allclose(motion.flow(x, 0.4)[:4], F @ x[:4], atol=1e-12)
    np.testing.assert_allclose(_linear(turning)[1][0].values[0][:4, :4], Q, atol=1e-12)
    assert turning.initial_deviation[4] < 1


def _linear(node_type):
    transition = discretise(SceneGraph.of([0], node_type), 0.4)
    return transition.F, transition.Q


def test_settings_out_of_range_are_refused():
    for refused, name in (
        (lambda: Bicycle(wheelbase=0.0), "wheelbase"),
        (lambda: CoordinatedTurn(turn_noise=-1.0), "turn_noise"),
    ):
        with pytest.raises(InputError, match=name):
            refused()

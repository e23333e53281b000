"""Nonlinear interactions: a node's next state is a function of its own and its neighbours' states."""

import gtsam
import numpy as np
import pytest

from factors import ResidualFactors, SolverSettings, nonlinear_graph, prior_factor, solve

DT = 0.2


def coordinated_turn(x):
    """Coordinated turn with state (px, py, speed, heading, turn rate)."""
    px, py, speed, heading, rate = np.moveaxis(x, -1, 0)
    chord = speed * DT * np.sinc(rate * DT / (2 * np.pi))
    middle = heading + rate * DT / 2
    ahead = [px + chord * np.cos(middle), py + chord * np.sin(middle), speed, heading + rate * DT, rate]
    return np.stack(ahead, axis=-1)


def intelligent_driver(x, *others):
    """Intelligent Driver Model (Treiber et al., Phys. Rev. E 62, 2000); state (position, speed) along the lane."""
    s, v = x[..., 0], x[..., 1]
    interaction = 0.0
    for leader in others:
        wanted = 2.0 + 1.5 * v + v * (v - leader[..., 1]) / (2 * np.sqrt(1.5 * 2.0))
        interaction = interaction + (wanted / (leader[..., 0] - s - 5.0)) ** 2
    a = 1.5 * (1 - (v / 30.0) ** 4 - interaction)
    return np.stack([s + v * DT + 0.5 * a * DT * DT, v + a * DT], axis=-1)


def test_turning_past_pi_is_no_jump():
    factor = ResidualFactors([[1, 0]], (5, 5), lambda later, x: later - coordinated_turn(x), np.eye(5), angles=(3,))
    values = gtsam.Values()
    values.insert(0, np.array([0.0, 0.0, 5.0, np.pi - 0.01, 0.2]))
    values.insert(1, coordinated_turn(values.atVector(0)) - [0, 0, 0, 2 * np.pi, 0])
    assert factor.error(values) == pytest.approx(0.0, abs=1e-12)
    assert np.abs(factor.linearise(values).at(0).jacobian()[0]).max() < 10


def followers(n, steps):
    """A queue of drivers: graph of priors and interactions, and a start away from the solution."""
    rng = np.random.default_rng(0)
    states = np.stack([100.0 - 20.0 * np.arange(n), 10.0 + rng.normal(size=n)], axis=1)
    native, ours, start = [], [], gtsam.Values()
    for t in range(steps + 1):
        for i in range(n):
            key = 1000 * t + i
            start.insert(key, states[i] + 0.3 * rng.normal(size=2))
            native.append(prior_factor(key, states[i] + 0.5 * rng.normal(size=2), 0.25 * np.eye(2)))
            if t < steps:
                keys = [key + 1000, key, key - 1][: 2 + bool(i)]
                residual = lambda later, *states: later - intelligent_driver(*states)  # noqa: E731
                ours.append(ResidualFactors([keys], (2,) * len(keys), residual, np.diag([0.01, 0.04])))
        states = np.stack([intelligent_driver(x, *([states[i - 1]] if i else [])) for i, x in enumerate(states)])
    return nonlinear_graph(native, dict.fromkeys(start.keys(), 2)), ours, start


@pytest.mark.parametrize("method", ["levenberg-marquardt", "line-search"])
def test_gtsams_solvers_reach_the_same_minimum(method):
    graph, ours, start = followers(5, 4)
    solution = solve(graph, ours, start, SolverSettings(method=method))
    assert solution.converged

    whole = graph.clone()
    for factor in ours:
        whole.add(factor.custom_factors()[0])
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-15)
    params.setAbsoluteErrorTol(1e-15)
    theirs = gtsam.LevenbergMarquardtOptimizer(whole, start, params).optimize()
    assert solution.error == pytest.approx(whole.error(theirs), rel=1e-9)
    keys = start.keys()
    for key in keys:
        np.testing.assert_allclose(solution.values.atVector(key), theirs.atVector(key), atol=1e-5)

    marginals = gtsam.Marginals(whole, theirs)
    key = keys[-1]
    np.testing.assert_allclose(solution.covariance([key]), marginals.marginalCovariance(key), rtol=1e-4)

    careful = gtsam.ISAM2Params()
    careful.setRelinearizeThreshold(1e-6)
    careful.relinearizeSkip = 1
    isam = gtsam.ISAM2(careful)
    isam.update(whole, start)
    for _ in range(10):
        isam.update()
    np.testing.assert_allclose(isam.calculateBestEstimate().atVector(key), theirs.atVector(key), atol=1e-5)

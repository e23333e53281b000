"""The general nonlinear interaction with three functions a researcher might write, all in his own NumPy."""

import gtsam
import numpy as np
import pytest

from factors import FactorError, NonlinearInteraction, Robust, SolverSettings, nonlinear_graph, prior_factor, solve


def social_repulsion(x, others, dt):
    """Social force (Helbing and Molnar, Phys. Rev. E 51, 1995): exponential repulsion; state (px, py, vx, vy)."""
    force = np.zeros_like(x[..., :2])
    for other in others:
        away = x[..., :2] - other[..., :2]
        distance = np.sqrt((away**2).sum(axis=-1, keepdims=True) + 0.01)
        force = force + 2.0 * np.exp(-distance / 1.5) * away / distance
    v = x[..., 2:] + force * dt
    return np.concatenate([x[..., :2] + v * dt, v], axis=-1)


def social_repulsion_jacobians(x, others, dt):
    F, blocks, eye = np.zeros((*x.shape, 4)), [], np.eye(2)
    F[..., :2, :2], F[..., :2, 2:], F[..., 2:, 2:] = eye, dt * eye, eye
    for other in others:
        away = (x[..., :2] - other[..., :2])[..., None]
        outer = away * away.swapaxes(-1, -2)
        distance = np.sqrt((away**2).sum(axis=-2, keepdims=True) + 0.01)
        own = 2.0 * np.exp(-distance / 1.5) / distance * (eye - outer / distance * (1 / 1.5 + 1 / distance))
        block = np.zeros((*x.shape, other.shape[-1]))
        block[..., :2, :2], block[..., 2:, :2] = -own * dt * dt, -own * dt
        F[..., :2] -= block[..., :2]
        blocks.append(block)
    return F, blocks


def coordinated_turn(x, others, dt):
    """Coordinated turn with state (px, py, speed, heading, turn rate); nobody else matters."""
    px, py, speed, heading, rate = np.moveaxis(x, -1, 0)
    chord = speed * dt * np.sinc(rate * dt / (2 * np.pi))
    middle = heading + rate * dt / 2
    ahead = [px + chord * np.cos(middle), py + chord * np.sin(middle), speed, heading + rate * dt, rate]
    return np.stack(ahead, axis=-1)


def intelligent_driver(x, others, dt):
    """Intelligent Driver Model (Treiber et al., Phys. Rev. E 62, 2000); state (position, speed) along the lane."""
    s, v = x[..., 0], x[..., 1]
    interaction = 0.0
    for leader in others:
        wanted = 2.0 + 1.5 * v + v * (v - leader[..., 1]) / (2 * np.sqrt(1.5 * 2.0))
        interaction = interaction + (wanted / (leader[..., 0] - s - 5.0)) ** 2
    a = 1.5 * (1 - (v / 30.0) ** 4 - interaction)
    return np.stack([s + v * dt + 0.5 * a * dt * dt, v + a * dt], axis=-1)


CASES = {
    "repulsion": (NonlinearInteraction(social_repulsion), 4, [4, 2, 6, 4]),
    "repulsion, analytic": (NonlinearInteraction(social_repulsion, social_repulsion_jacobians), 4, [4, 2, 6, 4]),
    "turn": (NonlinearInteraction(coordinated_turn, angles=(3,)), 5, []),
    "following": (NonlinearInteraction(intelligent_driver), 2, [2]),
}
N = 3


def random_case(name, seed, covariance, robust=None):
    rng = np.random.default_rng(seed)
    interaction, d, others = CASES[name]
    keys = rng.permutation(100)[: N * (2 + len(others))].reshape(N, -1)  # unsorted
    states = [2 * rng.normal(size=(N, dim)) for dim in (d, d, *others)]
    if name == "following":
        states[2][:, 0] = states[1][:, 0] + 25.0
    states[0] = interaction.predict(states[1], states[2:], 0.3) + 0.3 * rng.normal(size=(N, d))
    values = gtsam.Values()
    for column, stack in zip(keys.T.tolist(), states, strict=True):
        for key, state in zip(column, stack, strict=True):
            values.insert(key, state)
    Q = np.stack([covariance(rng, d) for _ in range(N)])
    return interaction.factors(keys[:, 0], keys[:, 1:], [d, *others], 0.3, Q, robust), states, values, Q


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", CASES)
def test_error_and_linearisation_follow_the_definition(name, seed, covariance):
    factors, states, values, Q = random_case(name, seed, covariance)
    residuals = states[0] - CASES[name][0].predict(states[1], states[2:], 0.3)
    expected = [0.5 * r @ np.linalg.solve(noise, r) for r, noise in zip(residuals, Q, strict=True)]
    np.testing.assert_allclose(factors.errors(values), expected, rtol=1e-9)
    assert [linear.keys() for linear in map(factors.linearise(values).at, range(N))] == factors.rows.tolist()
    step, rng = gtsam.VectorValues(), np.random.default_rng(seed)
    for key, dim in values.dims().items():
        step.insert(key, 1e-5 * rng.normal(size=dim))
    moved = factors.error(values.retract(step))
    assert factors.linearise(values).error(step) == pytest.approx(moved, rel=1e-7, abs=1e-9)


@pytest.mark.parametrize("seed", range(2))
def test_analytic_and_numerical_jacobians_agree(seed, covariance):
    numerical, _, values, _ = random_case("repulsion", seed, covariance, Robust("cauchy", 0.5))
    analytic, *_ = random_case("repulsion, analytic", seed, covariance, Robust("cauchy", 0.5))
    pairs = zip(numerical.linearisation(values)[1], analytic.linearisation(values)[1], strict=True)
    for one, other in pairs:
        np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-8)


def test_turning_past_pi_is_no_jump():
    interaction, _, _ = CASES["turn"]
    factor = interaction.factors([1], [[0]], 5, 1.0, np.eye(5))
    values = gtsam.Values()
    values.insert(0, np.array([0.0, 0.0, 5.0, np.pi - 0.1, 0.2]))
    values.insert(1, interaction.predict(values.atVector(0), [], 1.0) - [0, 0, 0, 2 * np.pi, 0])
    assert factor.error(values) == pytest.approx(0.0, abs=1e-12)
    assert np.abs(factor.linearise(values).at(0).jacobian()[0]).max() < 10


def test_bad_interactions_are_refused(subtests):
    for change, message in [
        ({"keys": [1, 2]}, r"keys: expected shape \(2, 1 \+ k\)"),
        ({"keys": [[1, 2]]}, r"keys: expected shape \(2, 1 \+ k\)"),
        ({"keys": [[1, 1], [2, 1]]}, "1 occurs twice"),
        ({"dims": [2, 2, 2]}, "rows: expected shape"),
        ({"covariances": np.ones((2, 2))}, "singular"),
        ({"dims": [2, 0]}, "positive integer"),
        ({"covariances": np.eye(3)}, "covariances: expected shape"),
        ({"dt": -1.0}, "dt"),
        ({"dt": np.nan}, "dt"),
        ({"next_keys": [5, -6]}, "integers"),
    ]:
        given = {
            "next_keys": [11, 12],
            "keys": [[1, 2], [2, 1]],
            "dims": 2,
            "dt": 0.1,
            "covariances": np.eye(2),
        } | change
        with subtests.test(message), pytest.raises(FactorError, match=message):
            CASES["following"][0].factors(**given)


def test_faulty_functions_become_factor_errors(subtests):
    for predict, jacobians, message in [
        (lambda x, others, dt: x[:, :1], None, r"prediction: expected shape \(1, 2\), got \(1, 1\)"),
        (lambda x, others, dt: x * np.nan, None, "finite"),
        (lambda x, others, dt: None, None, "prediction"),
        (lambda x, others, dt: x, lambda x, others, dt: (np.eye(2)[None], []), "a list of 3 Jacobians"),
        (lambda x, others, dt: x, lambda x, others, dt: (np.eye(3)[None], [np.eye(2)[None]]), "Jacobian 1"),
        (lambda x, others, dt: x, lambda x, others, dt: None, "TypeError"),
    ]:
        factor = NonlinearInteraction(predict, jacobians).factors([1], [[2, 3]], 2, 0.1, np.eye(2))
        values = gtsam.Values()
        for key in (1, 2, 3):
            values.insert(key, np.ones(2))
        with subtests.test(message), pytest.raises(FactorError, match=message):
            factor.linearise(values)


def followers(n, steps, seed):
    """A queue of drivers: graph of priors and interactions, and a start away from the solution."""
    rng = np.random.default_rng(seed)
    interaction = CASES["following"][0]
    states = np.stack([100.0 - 20.0 * np.arange(n), 10.0 + rng.normal(size=n)], axis=1)
    native, ours, start = [], [], gtsam.Values()
    for t in range(steps + 1):
        for i in range(n):
            key = 1000 * t + i
            start.insert(key, states[i] + 0.3 * rng.normal(size=2))
            native.append(prior_factor(key, states[i] + 0.5 * rng.normal(size=2), 0.25 * np.eye(2)))
            if t < steps:
                keys = [[key, key - 1] if i else [key]]
                ours.append(interaction.factors([key + 1000], keys, 2, 0.2, np.diag([0.01, 0.04])))
        states = np.stack([interaction.predict(x, [states[i - 1]] if i else [], 0.2) for i, x in enumerate(states)])
    return nonlinear_graph(native, dict.fromkeys(start.keys(), 2)), ours, start


@pytest.mark.parametrize("method", ["levenberg-marquardt", "line-search"])
def test_gtsams_solvers_reach_the_same_minimum(method):
    graph, ours, start = followers(5, 4, 0)
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

"""The general nonlinear interaction with three functions a researcher might write, all in his own NumPy."""

import pickle

import gtsam
import numpy as np
import pytest

from factors import FactorError, NonlinearInteraction, Robust, SolverSettings, interaction_factor, prior_factor, solve
from factors.gaussian import nonlinear_graph


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


def raises(x, others, dt):
    raise RuntimeError("no such thing")


CASES = {
    "repulsion": (NonlinearInteraction(social_repulsion), 4, [4, 2, 6, 4]),
    "repulsion, analytic": (NonlinearInteraction(social_repulsion, social_repulsion_jacobians), 4, [4, 2, 6, 4]),
    "turn": (NonlinearInteraction(coordinated_turn, angles=(3,)), 5, []),
    "following": (NonlinearInteraction(intelligent_driver), 2, [2]),
}


def random_case(name, seed, covariance, robust=None):
    rng = np.random.default_rng(seed)
    interaction, d, others = CASES[name]
    keys = rng.permutation(100)[: 2 + len(others)].tolist()  # unsorted
    states = [rng.normal(size=dim) * 2 for dim in (d, d, *others)]
    if name == "following":
        states[2][0] = states[1][0] + 25.0
    states[0] = interaction.predict(states[1], states[2:], 0.3) + 0.3 * rng.normal(size=d)
    values = gtsam.Values()
    for key, state in zip(keys, states, strict=True):
        values.insert(key, state)
    Q = covariance(rng, d)
    factor = interaction.factor(keys[0], keys[1], keys[2:], [d, *others], 0.3, Q, robust)
    return rng, interaction, states, values, factor, Q


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", CASES)
def test_error_and_linearisation_follow_the_definition(name, seed, covariance):
    rng, interaction, states, values, factor, Q = random_case(name, seed, covariance)
    residual = states[0] - interaction.predict(states[1], states[2:], 0.3)
    assert factor.error(values) == pytest.approx(0.5 * residual @ np.linalg.solve(Q, residual), rel=1e-9)

    linear = factor.linearise(values)
    assert linear.keys() == list(factor.keys)
    size = 1e-5
    increments, moved = gtsam.VectorValues(), gtsam.Values()
    for key, state in zip(factor.keys, states, strict=True):
        delta = size * rng.normal(size=len(state))
        increments.insert(key, delta)
        moved.insert(key, state + delta)
    assert linear.error(increments) == pytest.approx(factor.error(moved), rel=1e-7, abs=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_analytic_and_numerical_jacobians_agree(seed, covariance):
    *_, values, numerical, _ = random_case("repulsion", seed, covariance)
    *_, analytic, _ = random_case("repulsion, analytic", seed, covariance)
    A = numerical.linearise(values).augmentedJacobian()
    np.testing.assert_allclose(A, analytic.linearise(values).augmentedJacobian(), rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("robust", [None, Robust("cauchy", 0.5)])
@pytest.mark.parametrize("name", CASES)
def test_custom_factor_is_the_same_factor(name, robust, covariance):
    *_, values, factor, _ = random_case(name, 0, covariance, robust)
    for custom in (factor.as_custom_factor(), factor.as_tolerant_custom_factor(values, pytest.fail)):
        assert custom.keys() == list(factor.keys)
        assert custom.error(values) == pytest.approx(factor.error(values), rel=1e-9)
        theirs, ours = custom.linearize(values), factor.linearise(values)
        np.testing.assert_allclose(theirs.augmentedInformation(), ours.augmentedInformation(), rtol=1e-7, atol=1e-9)


def test_turning_past_pi_is_no_jump():
    interaction, _, _ = CASES["turn"]
    factor = interaction.factor(1, 0, [], 5, 1.0, np.eye(5))
    values = gtsam.Values()
    values.insert(0, np.array([0.0, 0.0, 5.0, np.pi - 0.1, 0.2]))
    values.insert(1, interaction.predict(values.atVector(0), [], 1.0) - [0, 0, 0, 2 * np.pi, 0])
    assert factor.error(values) == pytest.approx(0.0, abs=1e-12)
    assert np.abs(factor.linearise(values).jacobian()[0]).max() < 10


@pytest.mark.parametrize("name", CASES)
def test_affine_form_is_the_linear_interaction(name, covariance):
    _, interaction, states, values, factor, Q = random_case(name, 1, covariance)
    F, F_others, b = interaction.affine(states[1], states[2:], 0.3)
    linear = interaction_factor(factor.keys[0], factor.keys[1:], [F, *F_others], b, Q)
    wrapped = nonlinear_graph([linear], {key: len(state) for key, state in zip(factor.keys, states, strict=True)})
    assert wrapped.error(values) == pytest.approx(factor.error(values), rel=1e-9)
    blocks, ours = linear.jacobian()[0], factor.linearise(values).jacobian()[0]  # copies; getA() would be a view
    np.testing.assert_allclose(ours, blocks, atol=1e-7)


@pytest.mark.parametrize("robust", [None, Robust("huber", 0.5)])
@pytest.mark.parametrize("name", CASES)
def test_many_at_once_equal_one_by_one(name, robust, covariance):
    cases = [random_case(name, seed, covariance, robust) for seed in range(4)]
    _, d, others = CASES[name]
    values, alone = gtsam.Values(), []
    for i, (_, interaction, states, _, factor, Q) in enumerate(cases):
        keys = [1000 * i + key for key in factor.keys]
        for key, state in zip(keys, states, strict=True):
            values.insert(key, state)
        alone.append(interaction.factor(keys[0], keys[1], keys[2:], [d, *others], 0.3, Q, robust))
    rows = np.array([factor.keys for factor in alone])
    Q = np.stack([case[-1] for case in cases])
    together = CASES[name][0].factors(rows[:, 0], rows[:, 1], rows[:, 2:], [d, *others], 0.3, Q, robust)
    assert together.keys == tuple(sorted(rows.ravel().tolist()))
    np.testing.assert_allclose(together.errors(values), [factor.error(values) for factor in alone], rtol=1e-12)
    linear = together.linearise(values)
    for i, factor in enumerate(alone):
        expected = factor.linearise(values)
        assert linear.at(i).keys() == expected.keys()
        np.testing.assert_allclose(linear.at(i).augmentedJacobian(), expected.augmentedJacobian(), atol=1e-9)


def test_bad_lists_of_interactions_are_refused(subtests):
    for change, message in [
        ({"neighbours": [1, 2]}, r"neighbours: expected shape \(n, k\)"),
        ({"keys": [1, 2, 3]}, "with 3 and 2"),
        ({"dims": [2, 2, 2]}, "expected 2 dimensions"),
        ({"covariances": np.ones((2, 2))}, "singular"),
        ({"covariances": np.ones((3, 2, 2))}, "expected 2 covariances"),
        ({"dt": -1.0}, "dt"),
        ({"next_keys": [5, -6]}, "integers"),
    ]:
        with subtests.test(message):
            given = {
                "next_keys": [11, 12],
                "keys": [1, 2],
                "neighbours": [[2], [1]],
                "dims": 2,
                "dt": 0.1,
                "covariances": np.eye(2),
            } | change
            with pytest.raises(FactorError, match=message):
                CASES["following"][0].factors(**given)


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
                ahead = [key - 1] if i else []
                ours.append(interaction.factor(key + 1000, key, ahead, 2, 0.2, np.diag([0.01, 0.04])))
        states = np.stack([interaction.predict(x, [states[i - 1]] if i else [], 0.2) for i, x in enumerate(states)])
    return nonlinear_graph(native, dict.fromkeys(start.keys(), 2)), ours, start


@pytest.mark.parametrize("method", ["gauss-newton", "levenberg-marquardt"])
@pytest.mark.parametrize("seed", range(2))
def test_gtsams_solvers_reach_the_same_minimum(seed, method):
    graph, ours, start = followers(5, 4, seed)
    assert len(ours) == 20
    solution = solve(graph, ours, start, SolverSettings(method=method))
    assert solution.converged

    whole = graph.clone()
    for factor in ours:
        whole.add(factor.as_custom_factor())
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


def test_bad_factor_is_refused(subtests):
    for change, message in [
        ({"dims": [2]}, "expected 2 dimensions"),
        ({"dims": 0}, "positive integer"),
        ({"dt": -0.1}, "dt"),
        ({"dt": np.nan}, "dt"),
        ({"covariance": np.ones((2, 2))}, "singular"),
        ({"covariance": np.eye(3)}, "covariance: expected shape"),
        ({"neighbours": [1]}, "more than once"),
    ]:
        with subtests.test(message):
            given = {
                "next_key": 1,
                "key": 2,
                "neighbours": [3],
                "dims": 2,
                "dt": 0.1,
                "covariance": np.eye(2),
                **change,
            }
            with pytest.raises(FactorError, match=message):
                CASES["following"][0].factor(**given)


def values_of(*states):
    values = gtsam.Values()
    for key, state in enumerate(states, start=1):
        values.insert(key, np.asarray(state, float))
    return values


def test_faulty_functions_become_factor_errors(subtests):
    for predict, jacobians, message in [
        (raises, None, "raises on x1, 2, 3: RuntimeError.*no such thing"),
        (lambda x, others, dt: x[:1], None, r"prediction: expected shape \(2\), got \(1,\)"),
        (lambda x, others, dt: x * np.nan, None, "finite"),
        (lambda x, others, dt: None, None, "prediction"),
        (lambda x, others, dt: x, lambda x, others, dt: (np.eye(2), []), "one per neighbour"),
        (lambda x, others, dt: x, lambda x, others, dt: (np.eye(3), [np.eye(2)]), "jacobian of x"),
        (
            lambda x, others, dt: x,
            lambda x, others, dt: (np.eye(2), [np.full((2, 2), np.inf)]),
            "jacobian of neighbour 0",
        ),
        (lambda x, others, dt: x, lambda x, others, dt: None, "TypeError"),
        (lambda x, others, dt: np.add(x, 1, out=x), None, "read-only"),
    ]:
        with subtests.test(message):
            x1 = gtsam.symbol("x", 1)
            factor = NonlinearInteraction(predict, jacobians).factor(x1, 2, [3], 2, 0.1, np.eye(2))
            values = gtsam.Values()
            for key in (x1, 2, 3):
                values.insert(key, np.ones(2))
            with pytest.raises(FactorError, match=message):
                factor.linearise(values)


def test_missing_or_mistyped_variables_are_named():
    factor = CASES["following"][0].factor(1, 2, [3], 2, 0.1, np.eye(2))
    with pytest.raises(FactorError, match="intelligent_driver on 1, 2, 3: values has no 3"):
        factor.error(values_of([0, 0], [0, 0]))
    with pytest.raises(FactorError, match="3: expected a vector of 2 entries, got 1"):
        factor.error(values_of([0, 0], [0, 0], [0]))
    posed = values_of([0, 0], [0, 0])
    posed.insert(3, gtsam.Pose2())
    with pytest.raises(FactorError, match="another type"):
        factor.error(posed)


def test_factors_keep_no_view_of_the_callers_arrays():
    Q = np.eye(2)
    factor = CASES["following"][0].factor(1, 2, [3], 2, 0.1, Q)
    values = values_of([0, 9], [0, 10], [40, 10])
    before = factor.error(values), factor.as_custom_factor().error(values)
    Q *= 100
    assert (factor.error(values), factor.as_custom_factor().error(values)) == before


def test_factors_of_named_functions_survive_pickling(covariance):
    *_, values, factor, _ = random_case("repulsion", 2, covariance, Robust("huber", 1.0))
    assert pickle.loads(pickle.dumps(factor)).error(values) == factor.error(values)

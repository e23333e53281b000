"""The linear interaction factor against its definition, one by one and a whole step at a time."""

import pickle

import gtsam
import numpy as np
import pytest

from factors import (
    FactorError,
    gaussian_factor,
    gaussian_graph,
    interaction_factor,
    interaction_factors,
    nonlinear_graph,
    prior_factor,
)
from factors.gaussian import nonlinear_graph_at


def random_states(rng, dims):
    states = {key: rng.normal(size=dim) for key, dim in dims.items()}
    vectors, values = gtsam.VectorValues(), gtsam.Values()
    for key, state in states.items():
        vectors.insert(key, state)
        values.insert(key, state)
    return states, vectors, values


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("neighbours", [0, 1, 5, 30])
def test_error_is_the_mahalanobis_distance(seed, neighbours, covariance):
    rng = np.random.default_rng(seed)
    keys = rng.permutation(1000)[: neighbours + 2].tolist()  # unsorted
    dims = {key: int(rng.integers(1, 7)) for key in keys}
    d = dims[keys[0]]
    F = [rng.normal(size=(d, dims[key])) for key in keys[1:]]
    b, Q = rng.normal(size=d), covariance(rng, d)
    states, vectors, values = random_states(rng, dims)
    factor = interaction_factor(keys[0], keys[1:], F, b, Q)

    residual = states[keys[0]] - b - sum(block @ states[key] for block, key in zip(F, keys[1:], strict=True))
    expected = 0.5 * residual @ np.linalg.solve(Q, residual)
    assert factor.keys() == keys
    assert factor.error(vectors) == pytest.approx(expected, rel=1e-9)
    graph = nonlinear_graph([factor], dims)
    assert graph.error(values) == pytest.approx(expected, rel=1e-9)

    blocks = np.hstack([np.eye(d), *(-block for block in F)])
    np.testing.assert_allclose(factor.information(), blocks.T @ np.linalg.solve(Q, blocks), rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(factor.augmentedInformation()[:-1, -1], blocks.T @ np.linalg.solve(Q, b), atol=1e-8)


def test_three_keys_equal_gtsams_own_factor():
    rng = np.random.default_rng(0)
    A, b = rng.normal(size=(3, 2, 2)), rng.normal(size=2)
    sigmas = np.array([0.5, 2.0])
    ours = gaussian_factor([7, 3, 5], list(A), b, np.diag(sigmas**2))
    theirs = gtsam.JacobianFactor(7, A[0], 3, A[1], 5, A[2], b, gtsam.noiseModel.Diagonal.Sigmas(sigmas))
    np.testing.assert_allclose(ours.augmentedJacobian(), theirs.augmentedJacobian(), atol=1e-14)


def step(rng, n, degrees, d, e, covariance):
    """A random step as block compressed rows: keys at t are 0..n-1, at t+dt 1000 + i."""
    keys = np.concatenate([rng.permutation(n)[:degree] for degree in degrees]).astype(np.int64)
    F = rng.normal(size=(len(keys), d, e))
    Q = np.stack([covariance(rng, d) for _ in range(n)])
    return 1000 + np.arange(n), keys, np.concatenate([[0], np.cumsum(degrees)]), F, rng.normal(size=(n, d)), Q


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("d", "e"), [(4, 4), (2, 5), (1, 1)])
def test_whole_step_equals_factors_one_by_one(seed, d, e, covariance):
    rng = np.random.default_rng(seed)
    n = 12
    nexts, keys, indptr, F, b, Q = step(rng, n, rng.integers(0, 6, n), d, e, covariance)
    made = {
        factor.keys()[0]: factor
        for stack in interaction_factors(nexts, keys, indptr, F, b, Q)
        for factor in stack.native()
    }
    assert sorted(made) == nexts.tolist()
    for i, factor in enumerate(map(made.get, nexts.tolist())):
        own = slice(indptr[i], indptr[i + 1])
        alone = interaction_factor(int(nexts[i]), keys[own].tolist(), list(F[own]), b[i], Q[i])
        assert factor.keys() == alone.keys()
        np.testing.assert_allclose(factor.augmentedJacobian(), alone.augmentedJacobian(), atol=1e-12)


def test_step_of_no_nodes_has_no_factors():
    none = np.empty(0, dtype=int)
    assert interaction_factors(none, none, [0], np.empty((0, 4, 4)), np.empty((0, 4)), np.empty((0, 4, 4))) == []


def test_bad_steps_are_refused_by_name(covariance):
    rng = np.random.default_rng(1)
    good = dict(
        zip(["next_keys", "keys", "indptr", "F", "b", "Q"], step(rng, 3, [2, 1, 2], 2, 2, covariance), strict=True)
    )
    interaction_factors(**good)
    singular = good["Q"].copy()
    singular[1] = 1.0
    nan = good["F"].copy()
    nan[2, 1, 0] = np.nan
    bad = [
        ({"Q": singular}, r"Q\[1\].*singular"),
        ({"F": nan}, r"F\[2, 1, 0\].*finite"),
        ({"F": good["F"][:4]}, "F: expected shape"),
        ({"b": good["b"][:2]}, "b: expected shape"),
        ({"Q": np.eye(2)}, "Q: expected shape"),
        ({"indptr": [0, 2, 3, 4]}, "indptr"),
        ({"indptr": [0, 3, 2, 5]}, "indptr"),
        ({"indptr": [0.0, 2.0, 3.0, 5.0]}, "indptr"),
        ({"keys": [0, 0, 1, 0, 1]}, "0 occurs twice in one factor, the one on 1000, 0, 0"),
        ({"keys": [0, 1000, 1, 0, 1]}, "1000 occurs twice"),
        ({"next_keys": [1000, 1001, 1000]}, "1000 occurs twice"),
        ({"next_keys": [1000, 1001, -2]}, "integers"),
    ]
    for change, message in bad:
        with pytest.raises(FactorError, match=message):
            interaction_factors(**{**good, **change})


def test_bad_factor_is_refused(subtests):
    for F, b, Q, message in [
        ([np.eye(2)], [0.0, 0.0], np.eye(2), "keys: expected shape"),
        ([np.eye(2), np.eye(3)], [0.0, 0.0], np.eye(2), "F: expected shape"),
        ([np.eye(2), np.eye(2)], [0.0, np.nan], np.eye(2), "finite"),
        ([np.eye(2), np.eye(2)], [0.0, 0.0], np.ones((2, 2)), "singular"),
        ([np.eye(2), np.eye(2)], [[0.0, 0.0]], np.eye(2), "b: expected shape"),
        ([np.eye(2), np.zeros((2, 0))], [0.0, 0.0], np.eye(2), "one column per block"),
    ]:
        with subtests.test(message), pytest.raises(FactorError, match=message):
            interaction_factor(1, [2, 3], F, b, Q)


def filtered(transitions, offsets, Q, mean, P):
    for F, b in zip(transitions, offsets, strict=True):
        mean, P = F @ mean + b, F @ P @ F.T + Q
    return mean, P


@pytest.mark.parametrize("seed", range(3))
def test_chain_of_steps_is_the_kalman_prediction(seed, covariance):
    rng = np.random.default_rng(seed)
    n, d, steps = 4, 2, 3
    mean, P = rng.normal(size=(n, d)), [covariance(rng, d) for _ in range(n)]
    Q = [covariance(rng, d) for _ in range(n)]
    graph = gaussian_graph(prior_factor(i, mean[i], P[i]) for i in range(n))
    transitions, offsets = [], rng.normal(size=(steps, n, d))
    for t in range(steps):
        F = 0.5 * rng.normal(size=(n, n, d, d))
        transitions.append(F.swapaxes(1, 2).reshape(n * d, n * d))
        now, later = 100 * t + np.arange(n), 100 * (t + 1) + np.arange(n)
        (stack,) = interaction_factors(
            later, np.tile(now, n), n * np.arange(n + 1), F.reshape(n * n, d, d), offsets[t], Q
        )
        for factor in stack.native():
            graph.push_back(factor)
    block = np.zeros((2, n * d, n * d))
    for i in range(n):
        own = slice(i * d, (i + 1) * d)
        block[0, own, own], block[1, own, own] = P[i], Q[i]
    expected, covariances = filtered(transitions, offsets.reshape(steps, -1), block[1], mean.ravel(), block[0])

    last = (100 * steps + np.arange(n)).tolist()
    np.testing.assert_allclose(graph.optimize().vector(last), expected, atol=1e-9)
    remaining = graph.marginal(last)
    information, _ = remaining.hessian(gtsam.Ordering(last))
    np.testing.assert_allclose(np.linalg.inv(information), covariances, rtol=1e-8, atol=1e-9)


def test_incremental_solver_agrees_from_any_initial_value(covariance):
    rng = np.random.default_rng(4)
    factors = [prior_factor(0, [1.0, 2.0], covariance(rng, 2)), prior_factor(1, [3.0, -1.0], covariance(rng, 2))]
    factors.append(interaction_factor(2, [1, 0], [np.eye(2), 0.3 * np.eye(2)], [5.0, 6.0], covariance(rng, 2)))
    isam = gtsam.ISAM2()
    for start in range(3):
        values = gtsam.Values()
        values.insert(start, 10 * rng.normal(size=2))
        isam.update(nonlinear_graph([factors[start]], {0: 2, 1: 2, 2: 2}), values)
    estimate = isam.calculateBestEstimate()
    solution = gaussian_graph(factors).optimize()
    for key in range(3):
        np.testing.assert_allclose(estimate.atVector(key), solution.at(key), atol=1e-9)


def test_increments_from_a_point_keep_their_meaning():
    rng = np.random.default_rng(5)
    graph, point, moved = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.Values()
    pose = gtsam.Pose2(1.0, 2.0, 0.3)
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.1)
    graph.add(gtsam.PriorFactorPose2(4, pose, noise))
    point.insert(4, pose.retract(0.01 * rng.normal(size=3)))
    moved.insert(4, point.atPose2(4).retract(1e-4 * rng.normal(size=3)))
    wrapped = nonlinear_graph_at([graph.linearize(point).at(0)], point)
    assert wrapped.error(moved) == pytest.approx(graph.error(moved), rel=1e-3)


def test_wrong_dimensions_are_refused_when_wrapped():
    factor = prior_factor(gtsam.symbol("x", 1), [1.0, 2.0], np.eye(2))
    with pytest.raises(FactorError, match="x1"):
        nonlinear_graph([factor], {2: 2})
    with pytest.raises(FactorError, match="2 columns"):
        nonlinear_graph([factor], {gtsam.symbol("x", 1): 3})


def test_factors_survive_pickling(covariance):
    rng = np.random.default_rng(6)
    stacks = interaction_factors(*step(rng, 4, [4, 3, 2, 1], 2, 2, covariance))
    factors = [factor for stack in stacks for factor in stack.native()]
    graph = pickle.loads(pickle.dumps(gaussian_graph(factors)))
    for i, factor in enumerate(factors):
        np.testing.assert_array_equal(graph.at(i).augmentedJacobian(), factor.augmentedJacobian())


def test_factors_keep_no_view_of_the_callers_arrays(covariance):
    rng = np.random.default_rng(7)
    b, Q, F = np.zeros(2), np.eye(2), np.eye(2)
    factor = interaction_factor(1, [0], [F], b, Q)
    before = factor.augmentedJacobian().copy()
    for array in (b, Q, F):
        array += rng.normal(size=array.shape)
    np.testing.assert_array_equal(factor.augmentedJacobian(), before)

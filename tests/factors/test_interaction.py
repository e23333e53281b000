"""Interactions and factors of a residual function."""

import pickle

import gtsam
import numpy as np
import pytest

from factors import (
    FactorError,
    Mixture,
    PlanarPose,
    Radar,
    RangeBearing,
    ResidualFactors,
    Robust,
    SolverSettings,
    SpatialPose,
    Vector,
    detection_factors,
    gaussian_graph,
    interaction_factor,
    interaction_factors,
    nonlinear_graph,
    prior_factor,
    residual_factor,
    solve,
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


def test_no_nodes_and_no_factors_cost_nothing():
    none = np.empty(0, dtype=int)
    assert interaction_factors(none, none, [0], np.empty((0, 4, 4)), np.empty((0, 4)), np.empty((0, 4, 4))) == []
    factors = detection_factors(none, RangeBearing(4), np.empty((0, 2)), np.eye(2))
    assert factors.error(gtsam.Values()) == 0.0
    assert factors.linearise(gtsam.Values()).size() == 0


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


def test_factors_of_steps_survive_pickling_and_keep_no_view_of_the_callers_arrays(covariance):
    rng = np.random.default_rng(6)
    stacks = interaction_factors(*step(rng, 4, [4, 3, 2, 1], 2, 2, covariance))
    factors = [factor for stack in stacks for factor in stack.native()]
    graph = pickle.loads(pickle.dumps(gaussian_graph(factors)))
    for i, factor in enumerate(factors):
        np.testing.assert_array_equal(graph.at(i).augmentedJacobian(), factor.augmentedJacobian())
    rng = np.random.default_rng(7)
    b, Q, F = np.zeros(2), np.eye(2), np.eye(2)
    factor = interaction_factor(1, [0], [F], b, Q)
    before = factor.augmentedJacobian().copy()
    for array in (b, Q, F):
        array += rng.normal(size=array.shape)
    np.testing.assert_array_equal(factor.augmentedJacobian(), before)


# Nonlinear interactions: a node's next state is a function of its own and its neighbours' states

DT = 0.2


def intelligent_driver(x, *others):
    """Intelligent Driver Model (Treiber et al., Phys. Rev. E 62, 2000); state (position, speed) along the lane."""
    s, v = x[..., 0], x[..., 1]
    interaction = 0.0
    for leader in others:
        wanted = 2.0 + 1.5 * v + v * (v - leader[..., 1]) / (2 * np.sqrt(1.5 * 2.0))
        interaction = interaction + (wanted / (leader[..., 0] - s - 5.0)) ** 2
    a = 1.5 * (1 - (v / 30.0) ** 4 - interaction)
    return np.stack([s + v * DT + 0.5 * a * DT * DT, v + a * DT], axis=-1)


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


# Factors from a user's functions: one or many together, in our solver and in GTSAM's, and errors that say where

N = 6
MODELS = {"polar": RangeBearing(4), "radar": Radar(5, (4, 0), (1, 2), (1.0, 2.0, 0.5))}


def scene(model, seed=0):
    rng = np.random.default_rng(seed)
    keys = rng.permutation(100)[:N]
    x = 5 * rng.normal(size=(N, model.state_dim))
    values = gtsam.Values()
    for key, state in zip(keys.tolist(), x, strict=True):
        values.insert(key, state)
    return rng, keys, values, model.predict(x) + 0.5 * rng.normal(size=(N, model.dim))


def alone(key, model, z, R, robust=None):
    """The factor of a detection, from a function of one state, differentiated numerically."""
    angles = tuple(model.angles)
    return residual_factor([key], [model.state_dim], lambda x: model.predict(x) - z, R, robust=robust, angles=angles)


@pytest.mark.parametrize("robust", [None, Robust("geman-mcclure", 0.7)])
@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_together_one_by_one_and_in_gtsam_they_are_the_same(model, shared, robust, covariance):
    rng, keys, values, z = scene(model)
    R = covariance(rng, model.dim) if shared else np.stack([covariance(rng, model.dim) for _ in range(N)])
    together = detection_factors(keys, model, z, R, robust)
    linear = together.linearise(values)
    assert linear.size() == N
    for i, custom in enumerate(together.custom_factors()):
        noise = R if shared else R[i]
        residual = together.residuals_at(together.states(values))[i]
        square = residual @ np.linalg.solve(noise, residual)
        cost = 0.5 * square if robust is None else float(robust.cost(np.sqrt(square)))
        single = alone(int(keys[i]), model, z[i], noise, robust)
        for error in (together.errors(values)[i], single.error(values), custom.error(values)):
            assert error == pytest.approx(cost, rel=1e-9)
        expected = single.linearise(values).at(0)
        np.testing.assert_allclose(linear.at(i).augmentedJacobian(), expected.augmentedJacobian(), atol=1e-7)
        theirs = custom.linearize(values).augmentedInformation()
        np.testing.assert_allclose(theirs, linear.at(i).augmentedInformation(), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("spatial", [False, True])
def test_states_of_one_factor_are_gtsams_and_differentiated_on_their_manifolds(spatial):
    d, kind, pose = (
        (3, SpatialPose(), gtsam.Pose3(gtsam.Rot3.Ypr(0.3, 0.2, -0.4), np.array([1.0, 2, 3])))
        if spatial
        else (2, PlanarPose(), gtsam.Pose2(1.0, 2.0, 0.4))
    )
    factor = residual_factor((9, 4), (kind, Vector(d)), lambda pose, point: pose.transformTo(point), np.eye(d))
    values = gtsam.Values()
    values.insert(9, pose)
    values.insert(4, np.arange(3.0, 3.0 + d))
    exact = [np.zeros((d, n), order="F") for n in (kind.dim, d)]
    pose.transformTo(values.atVector(4), *exact)
    for found, expected in zip(factor.linearisation(values)[1], exact, strict=True):
        np.testing.assert_allclose(found[0], expected, atol=1e-8)


def test_factors_survive_pickling_and_keep_no_view_of_the_callers_arrays(covariance):
    rng, keys, values, z = scene(MODELS["radar"])
    R = covariance(rng, 3)
    factors = detection_factors(keys, MODELS["radar"], z, R, Robust("huber", 1.0))
    before = factors.error(values)
    assert pickle.loads(pickle.dumps(factors)).error(values) == before
    R *= 100
    z += 1
    assert factors.error(values) == before


def difference(x, y):
    return x - y


def test_bad_fields_are_refused(subtests):
    for given, message in [
        ({"rows": [[1, 2], [3, 4, 5]]}, "rows of the same length"),
        ({"rows": [1, 2]}, "rows: expected shape"),
        ({"rows": [[1], [2]]}, "rows: expected shape"),
        ({"rows": [[1, 1], [3, 4]]}, "1 occurs twice"),
        ({"variables": (2, 0)}, "dim: expected a positive integer"),
        ({"variables": (2, SpatialPose())}, "jacobians: expected a function"),
        ({"covariances": np.eye(2)[:1]}, "square"),
        ({"covariances": [np.eye(2)] * 3}, "expected 2 covariances"),
        ({"covariances": np.ones((2, 2))}, "singular"),
        ({"angles": (2,)}, "angles"),
    ]:
        fields = {
            "rows": [[1, 2], [3, 4]],
            "variables": (2, 2),
            "residual": difference,
            "covariances": np.eye(2),
            **given,
        }
        with subtests.test(message), pytest.raises(FactorError, match=message):
            ResidualFactors(**fields)


def test_faulty_functions_become_factor_errors(subtests):
    for residual, jacobians, message in [
        (lambda x, y: x[:, :1] - y[:, :1], None, r"2 factors on 1, 3: residual: expected shape \(2, 2\)"),
        (lambda x, y: np.full(x.shape, np.nan), None, r"residual\[0, 0\]: expected a finite number"),
        (lambda x, y: 1 / 0, None, "ZeroDivisionError"),
        (difference, lambda x, y: None, "a list of 2 Jacobians"),
        (difference, lambda x, y: [np.zeros((2, 2, 2))], "a list of 2 Jacobians"),
        (difference, lambda x, y: [np.zeros((2, 2, 2)), np.zeros((2, 2))], "Jacobian 1: expected shape"),
        (lambda x, y: np.add(x, y, out=x), None, "read-only"),
    ]:
        factors = ResidualFactors(np.array([[1, 2], [3, 4]]), (2, 2), residual, np.eye(2), jacobians)
        values = gtsam.Values()
        for key in range(1, 5):
            values.insert(key, np.ones(2))
        with subtests.test(message), pytest.raises(FactorError, match=message):
            factors.linearise(values)


@pytest.mark.parametrize("single", [False, True])
def test_missing_or_mistyped_variables_are_named(single):
    both = ResidualFactors(np.array([[1, 2]]), (2, 2), difference, np.eye(2))
    factors = residual_factor((1, 2), (2, 2), difference, np.eye(2)) if single else both
    values = gtsam.Values()
    values.insert(1, np.ones(2))
    with pytest.raises(FactorError, match="values has no 2"):
        factors.error(values)
    values.insert(2, np.ones(3))
    with pytest.raises(FactorError, match="2: expected a vector of 2 entries, got 3"):
        factors.error(values)
    values.erase(2)
    values.insert(2, gtsam.Pose2())
    with pytest.raises(FactorError, match="another type of variable"):
        factors.error(values)


def test_some_rows_need_the_variables_of_those_rows_alone():
    """Variables of other rows need not exist."""
    offsets = np.arange(6.0).reshape(3, 2)
    batch = ResidualFactors([[1], [2], [3]], (2,), lambda x: x - offsets, np.eye(2), robust=Robust("cauchy", 1.0))
    values = gtsam.Values()
    for key in (1, 3):
        values.insert(key, np.array([key, 1.0]))
    chosen = np.array([0, 2])
    W, (J,), r = batch.linearisation(values, chosen)
    np.testing.assert_allclose(r, np.array([[1.0, 1.0], [3.0, 1.0]]) - offsets[chosen])
    np.testing.assert_allclose(J, np.broadcast_to(np.eye(2), (2, 2, 2)), atol=1e-8)
    values.insert(2, np.zeros(2))
    everything = batch.linearisation(values)
    np.testing.assert_allclose(W, everything[0][chosen])
    np.testing.assert_allclose(batch.errors(values, chosen), batch.errors(values)[chosen])


def test_stacked_factors_have_probabilities_of_their_own():
    rows, z = np.arange(3, dtype=np.uint64)[:, None], np.array([[0.5], [1.0], [2.0]])
    probability = [0.9, 0.5, 0.99]
    stack = ResidualFactors(rows, (1,), lambda x: x - z, np.eye(1), robust=Mixture(probability))
    values = gtsam.Values()
    for key in range(3):
        values.insert(key, np.zeros(1))
    expected = [float(Mixture(p).cost(s)) for p, s in zip(probability, z[:, 0], strict=True)]
    np.testing.assert_allclose(stack.errors(values), expected)
    np.testing.assert_allclose([one.error(values) for one in stack.custom_factors()], expected)

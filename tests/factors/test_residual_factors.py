"""Factors from a user's functions: one or many together, in our solver and in GTSAM's, and errors that say where."""

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
    SpatialPose,
    Vector,
    detection_factors,
    nonlinear_graph,
    prior_factors,
    residual_factor,
    solve,
)

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


def test_the_solver_takes_both_kinds():
    model = Radar(4, sensor_pose=(-40.0, 0.0, 0.0))
    rng, keys, start, _ = scene(model)
    z = model.predict(rng.normal(size=(N, 4)))
    first = prior_factors(keys, rng.normal(size=(N, 4)), np.eye(4)).native()
    prior = nonlinear_graph(first, dict.fromkeys(keys.tolist(), 4))
    R = np.diag([0.1, 0.01, 0.1])
    together = solve(prior, [detection_factors(keys, model, z, R)], start)
    singly = solve(prior, [alone(int(key), model, zi, R) for key, zi in zip(keys, z, strict=True)], start)
    assert together.converged
    for key in keys.tolist():
        np.testing.assert_allclose(together.values.atVector(key), singly.values.atVector(key), atol=1e-7)


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


def test_no_factors_cost_nothing():
    none = detection_factors(np.empty(0, int), RangeBearing(4), np.empty((0, 2)), np.eye(2))
    assert none.error(gtsam.Values()) == 0.0
    assert none.linearise(gtsam.Values()).size() == 0


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

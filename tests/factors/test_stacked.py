"""Many factors at once: the same answers as one by one, and errors that say where."""

import pickle

import gtsam
import numpy as np
import pytest

from factors import (
    FactorError,
    Radar,
    RangeBearing,
    ResidualFactors,
    Robust,
    box,
    detection_factor,
    detection_factors,
    nonlinear_graph,
    position,
    prior_factors,
    solve,
)

N = 6
MODELS = [position(4), box(6, (0, 1), (3, 4), 2), RangeBearing(4), Radar(5, (4, 0), (1, 2), (1.0, 2.0, 0.5))]


def scene(model, seed=0):
    rng = np.random.default_rng(seed)
    keys = rng.permutation(100)[:N]
    x = 5 * rng.normal(size=(N, model.state_dim))
    values = gtsam.Values()
    for key, state in zip(keys.tolist(), x, strict=True):
        values.insert(key, state)
    return rng, keys, values, model.predict(x) + 0.5 * rng.normal(size=(N, model.dim))


@pytest.mark.parametrize("robust", [None, Robust("geman-mcclure", 0.7)])
@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
def test_together_equal_one_by_one(model, shared, robust, covariance):
    rng, keys, values, z = scene(model)
    R = covariance(rng, model.dim) if shared else np.stack([covariance(rng, model.dim) for _ in range(N)])
    together = detection_factors(keys, model, z, R, robust)
    linear = together.linearise(values)
    assert linear.size() == N
    alone = [detection_factor(int(keys[i]), model, z[i], R if shared else R[i], robust) for i in range(N)]
    assert together.error(values) == pytest.approx(sum(factor.error(values) for factor in alone))
    for i, factor in enumerate(alone):
        np.testing.assert_allclose(
            linear.at(i).augmentedJacobian(), factor.linearise(values).augmentedJacobian(), atol=1e-12
        )


def test_solver_takes_both_kinds():
    model = Radar(4, sensor_pose=(-40.0, 0.0, 0.0))
    rng, keys, start, _ = scene(model)
    z = model.predict(rng.normal(size=(N, 4)))
    prior = nonlinear_graph(prior_factors(keys, rng.normal(size=(N, 4)), np.eye(4)), dict.fromkeys(keys.tolist(), 4))
    R = np.diag([0.1, 0.01, 0.1])
    together = solve(prior, [detection_factors(keys, model, z, R)], start)
    alone = solve(prior, [detection_factor(int(key), model, zi, R) for key, zi in zip(keys, z, strict=True)], start)
    assert together.converged
    for key in keys.tolist():
        np.testing.assert_allclose(together.values.atVector(key), alone.values.atVector(key), atol=1e-9)


def test_no_detections_are_no_factors():
    none = detection_factors(np.empty(0, int), position(4), np.empty((0, 2)), np.eye(2))
    assert none.error(gtsam.Values()) == 0.0
    assert none.linearise(gtsam.Values()).size() == 0


def test_survive_pickling(covariance):
    rng, keys, values, z = scene(MODELS[3])
    factors = detection_factors(keys, MODELS[3], z, covariance(rng, 3), Robust("huber", 1.0))
    assert pickle.loads(pickle.dumps(factors)).error(values) == factors.error(values)


def difference(x, y):
    return x - y


def test_bad_fields_are_refused(subtests):
    for given, message in [
        ({"rows": [[1, 2], [3, 4, 5]]}, "rows of the same length"),
        ({"rows": [1, 2]}, "rows: expected shape"),
        ({"rows": [[1], [2]]}, "rows: expected shape"),
        ({"dims": (2, 0)}, "dims"),
        ({"covariances": np.eye(2)[:1]}, "square"),
        ({"covariances": [np.eye(2)] * 3}, "expected 2 covariances"),
        ({"angles": (2,)}, "angles"),
    ]:
        with subtests.test(message), pytest.raises(FactorError, match=message):
            ResidualFactors(
                **{"rows": [[1, 2], [3, 4]], "dims": (2, 2), "residual": difference, "covariances": np.eye(2), **given}
            )


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
        with subtests.test(message):
            factors = ResidualFactors(np.array([[1, 2], [3, 4]]), (2, 2), residual, np.eye(2), jacobians)
            values = gtsam.Values()
            for key in range(1, 5):
                values.insert(key, np.ones(2))
            with pytest.raises(FactorError, match=message):
                factors.linearise(values)


def test_missing_or_mistyped_variables_are_named():
    factors = ResidualFactors(np.array([[1, 2]]), (2, 2), difference, np.eye(2))
    values = gtsam.Values()
    values.insert(1, np.ones(2))
    with pytest.raises(FactorError, match="values has no 2"):
        factors.error(values)
    values.insert(2, np.ones(3))
    with pytest.raises(FactorError, match="2: expected a vector of 2 entries, got 3"):
        factors.error(values)
    values.erase(2)
    values.insert(2, gtsam.Pose2())
    with pytest.raises(FactorError, match="another type of variable in 2"):
        factors.error(values)
    with pytest.raises(FactorError, match="1 occurs twice"):
        ResidualFactors(np.array([[1, 1]]), (2, 2), difference, np.eye(2))


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

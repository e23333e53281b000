"""Detection factors: analytic against numerical Jacobians, linear against nonlinear, angles, robust losses."""

import gtsam
import numpy as np
import pytest

from factors import (
    Bearing,
    Components,
    FactorError,
    Radar,
    Range,
    RangeBearing,
    RangeRate,
    Robust,
    Vector,
    box,
    detection_factor,
    gaussian_graph,
    linear_detection_factor,
    linear_detection_factors,
    position,
    position_velocity,
    prior_factor,
    solve,
)
from factors.gaussian import nonlinear_graph
from factors.manifolds import central_differences

POSE = (1.0, -2.0, 0.7)
LINEAR = [position(4), position(7, (2, 6, 0)), position_velocity(6, (0, 3), (1, 4)), box(8, (0, 1, 2), (5, 6, 7), 3)]
POLAR = [
    RangeBearing(4, (2, 0), POSE),
    Range(4, (2, 0), POSE),
    Bearing(5, (1, 4), POSE),
    RangeRate(5, (0, 3), (4, 1), POSE, (0.5, -1.0)),
    Radar(4, (0, 1), (2, 3), POSE, (0.5, -1.0)),
]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("model", LINEAR + POLAR, ids=lambda model: model.name)
def test_analytic_jacobian_is_the_numerical_one(model, seed):
    rng = np.random.default_rng(seed)
    x = 5 * rng.normal(size=model.state_dim)
    (numerical,) = central_differences(model.predict, [x], [Vector(model.state_dim)])
    np.testing.assert_allclose(model.jacobian(x), numerical, atol=1e-7)


@pytest.mark.parametrize("model", LINEAR + POLAR, ids=lambda model: model.name)
def test_many_states_at_once(model):
    x = 5 * np.random.default_rng(0).normal(size=(2, 3, model.state_dim))
    assert model.predict(x).shape == (2, 3, model.dim)
    assert model.jacobian(x).shape == (2, 3, model.dim, model.state_dim)
    np.testing.assert_allclose(model.predict(x)[1, 2], model.predict(x[1, 2]))
    np.testing.assert_allclose(model.jacobian(x)[1, 2], model.jacobian(x[1, 2]))


def test_polar_measurements_of_a_known_scene():
    x = np.array([1.0, 1.0, 2.0, 3.0])  # three metres to the left of a sensor that looks along x
    radar = Radar(4, sensor_pose=(1.0, -2.0, 0.0), sensor_velocity=(9.0, 1.0))
    np.testing.assert_allclose(radar.predict(x), [3.0, np.pi / 2, 2.0])
    np.testing.assert_allclose(RangeBearing(4, sensor_pose=(1.0, -2.0, np.pi / 2)).predict(x), [3.0, 0.0], atol=1e-15)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("model", LINEAR, ids=lambda model: model.name)
def test_linear_and_nonlinear_form_agree(model, seed, covariance):
    rng = np.random.default_rng(seed)
    R, x = covariance(rng, model.dim), rng.normal(size=model.state_dim)
    z = model.predict(x) + 0.1 * rng.normal(size=model.dim)
    values, vectors = gtsam.Values(), gtsam.VectorValues()
    values.insert(9, x)
    vectors.insert(9, x)
    linear = linear_detection_factor(9, model, z, R, near=x)
    nonlinear = detection_factor(9, model, z, R)
    residual = z - model.predict(x)
    expected = 0.5 * residual @ np.linalg.solve(R, residual)
    assert linear.error(vectors) == pytest.approx(expected, rel=1e-9)
    assert nonlinear.error(values) == pytest.approx(expected, rel=1e-9)
    assert nonlinear.as_custom_factor().error(values) == pytest.approx(expected, rel=1e-9)
    np.testing.assert_allclose(nonlinear.linearise(values).information(), linear.information(), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("model", LINEAR, ids=lambda model: model.name)
def test_many_linear_factors_at_once(model, covariance):
    rng = np.random.default_rng(0)
    n = 5
    z, near = 5 * rng.normal(size=(n, model.dim)), rng.normal(size=(n, model.state_dim))
    R = np.stack([covariance(rng, model.dim) for _ in range(n)])
    keys = rng.permutation(50)[:n]
    for factor, *one in zip(linear_detection_factors(keys, model, z, R, near), keys.tolist(), z, R, near, strict=True):
        key, measured, noise, state = one
        alone = linear_detection_factor(key, model, measured, noise, state)
        assert factor.keys() == [key]
        np.testing.assert_allclose(factor.augmentedJacobian(), alone.augmentedJacobian(), atol=1e-12)
    shared = linear_detection_factors(keys, model, z, R[0], near)
    np.testing.assert_allclose(
        shared[3].augmentedJacobian(),
        linear_detection_factor(int(keys[3]), model, z[3], R[0], near[3]).augmentedJacobian(),
        atol=1e-12,
    )


@pytest.mark.parametrize("turns", [-2, -1, 0, 1, 3])
def test_a_box_turned_all_the_way_round_is_the_same_box(turns):
    model = box(4, (0, 1), (2,), 3)
    x = np.array([0.0, 0.0, 4.5, np.pi - 0.05])
    z = np.array([0.1, 0.0, 4.4, -np.pi + 0.05 + 2 * np.pi * turns])  # 0.1 rad further
    values, vectors = gtsam.Values(), gtsam.VectorValues()
    values.insert(1, x)
    vectors.insert(1, x)
    expected = 0.5 * (0.1**2 + 0.1**2 + 0.1**2)
    assert detection_factor(1, model, z, np.eye(4)).error(values) == pytest.approx(expected)
    assert linear_detection_factor(1, model, z, np.eye(4), near=x).error(vectors) == pytest.approx(expected)


def test_bearing_across_the_cut():
    model = RangeBearing(2)
    values = gtsam.Values()
    values.insert(1, np.array([-10.0, -0.01]))
    error = detection_factor(1, model, [10.0, np.pi - 0.001], np.eye(2)).error(values)
    assert error == pytest.approx(0.5 * 0.002**2, rel=1e-2)


@pytest.mark.parametrize("loss", ["huber", "cauchy", "geman-mcclure", "tukey"])
def test_robust_detections_give_gtsams_answer(loss):
    rng = np.random.default_rng(1)
    robust, model, truth = Robust(loss, 2.0), Radar(4, sensor_pose=POSE), np.array([20.0, 5.0, 3.0, -1.0])
    R = np.diag([0.1, 0.01, 0.1]) ** 2
    z = model.predict(truth) + rng.normal(size=(12, 3)) @ np.sqrt(R)
    z[:2] += [8.0, 0.5, 4.0]  # outliers
    prior = nonlinear_graph([prior_factor(5, truth + 0.5 * rng.normal(size=4), np.eye(4))], {5: 4})
    ours = [detection_factor(5, model, measured, R, robust) for measured in z]
    start = gtsam.Values()
    start.insert(5, truth + 0.1 * rng.normal(size=4))
    solution = solve(prior, ours, start)
    assert solution.converged

    graph = prior.clone()
    for factor in ours:
        graph.add(factor.as_custom_factor())
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-14)
    params.setAbsoluteErrorTol(1e-14)
    theirs = gtsam.LevenbergMarquardtOptimizer(graph, start, params).optimize()
    np.testing.assert_allclose(solution.values.atVector(5), theirs.atVector(5), atol=1e-5)
    np.testing.assert_allclose(solution.values.atVector(5)[:2], truth[:2], atol=0.3)  # not drawn to the outliers


def test_range_bearing_agrees_with_gtsams_own_factor():
    pose, point = gtsam.Pose2(*POSE), np.array([6.0, 3.0])
    z, noise = np.array([9.0, 0.2]), gtsam.noiseModel.Diagonal.Sigmas(np.array([0.05, 0.3]))
    theirs = gtsam.BearingRangeFactor2D(1, 2, gtsam.Rot2(z[1]), z[0], noise)
    values = gtsam.Values()
    values.insert(1, pose)
    values.insert(2, point)
    ours = detection_factor(2, RangeBearing(2, sensor_pose=POSE), z, np.diag([0.3, 0.05]) ** 2)
    assert ours.error(values) == pytest.approx(theirs.error(values), rel=1e-9)


def test_detections_update_like_a_kalman_filter(covariance):
    rng = np.random.default_rng(3)
    mean, P, R, z = rng.normal(size=4), covariance(rng, 4), covariance(rng, 2), rng.normal(size=2)
    graph = gaussian_graph([prior_factor(0, mean, P), linear_detection_factor(0, position(4), z, R)])
    H = np.eye(4)[:2]
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    np.testing.assert_allclose(graph.optimize().at(0), mean + gain @ (z - H @ mean), atol=1e-9)


def test_bad_detections_are_refused(subtests):
    for make, message in [
        (lambda: position(4, (0, 4)), "position: expected distinct components from 0 to 3"),
        (lambda: position(4, (1, 1)), "distinct"),
        (lambda: position_velocity(4, (0, 1), (1, 2)), "distinct"),
        (lambda: Components(4, ()), "components"),
        (lambda: Components(4, (0.5,)), "components"),
        (lambda: Components(4, (0, 1), angles=(2,)), "angles"),
        (lambda: RangeBearing(4, (0, 1, 2)), "two components"),
        (lambda: RangeBearing(4, sensor_pose=(0.0, 0.0)), "sensor_pose"),
        (lambda: Radar(4, sensor_pose=(0.0, 0.0, np.nan)), "sensor_pose"),
        (lambda: RangeRate(4, (0, 1), (1, 2)), "distinct"),
        (lambda: detection_factor(0, position(4), [1.0], np.eye(2)), "z: expected shape"),
        (lambda: detection_factor(0, position(4), [1.0, np.nan], np.eye(2)), "finite"),
        (lambda: detection_factor(0, position(4), [1.0, 2.0], np.eye(3)), "R: expected shape"),
        (lambda: detection_factor(0, position(4), [1.0, 2.0], np.ones((2, 2))), "singular"),
        (lambda: linear_detection_factor(0, RangeBearing(4), [1.0, 2.0], np.eye(2)), "expected a linear one"),
        (lambda: linear_detection_factor(0, LINEAR[3], np.ones(7), np.eye(7)), "near"),
        (lambda: linear_detection_factors([0], position(4), np.ones((2, 2)), np.eye(2)), "keys"),
        (lambda: linear_detection_factors([0, 1], position(4), np.ones((2, 2)), np.ones((3, 2, 2))), "R: expected 2"),
    ]:
        with subtests.test(message), pytest.raises(FactorError, match=message):
            make()


def test_object_at_the_sensor_is_refused_when_linearised():
    factor = detection_factor(0, RangeBearing(2, sensor_pose=POSE), [1.0, 0.0], np.eye(2))
    values = gtsam.Values()
    values.insert(0, np.array(POSE[:2]))
    with pytest.raises(FactorError, match=r"range and bearing detection on 0.*at the sensor"):
        factor.linearise(values)

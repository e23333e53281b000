"""Factors on the pose of the vehicle: odometry with slow errors, and objects seen from it."""

import gtsam
import numpy as np
import pytest

from factors import (
    FactorError,
    ResidualFactors,
    Robust,
    SpatialPose,
    Vector,
    nonlinear_graph,
    odometry_factors,
    prior_factors,
    relative_detection_factors,
    solve,
)
from factors.manifolds import central_differences, cross_matrix, inverse_right_jacobian, rotation_exp, rotation_log

N = 5
SEEDS = range(4)


def random_poses(rng, n):
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = rotation_exp(rng.normal(0, 0.6, (n, 3)))
    poses[:, :3, 3] = rng.normal(0, 20, (n, 3))
    return poses


def values_of(keys, states):
    values = gtsam.Values()
    for key, state in zip(keys, states, strict=True):
        values.insert(int(key), gtsam.Pose3(state) if state.shape == (4, 4) else state)
    return values


def odometry(rng, covariance, robust=None):
    """n factors with keys in no order, and values at which their residuals are not small."""
    keys = rng.permutation(100)[: 4 * N].reshape(N, 4)
    a = random_poses(rng, N)
    steps = random_poses(rng, N)
    b = a @ steps
    b[:, :3, :3] = b[:, :3, :3] @ rotation_exp(rng.normal(0, 0.3, (N, 3)))
    b[:, :3, 3] += rng.normal(0, 0.5, (N, 3))
    errors = rng.normal(0, 0.1, (2, N, 3))
    values = values_of(keys.T.ravel(), [*a, *b, *errors[0], *errors[1]])
    R = np.stack([covariance(rng, 9) for _ in range(N)])
    return odometry_factors(keys, steps, rng.uniform(0.1, 2, N), R, robust), values, (a, b, *errors)


def sightings(rng, covariance, robust=None, dim=6, position=(3, 1)):
    keys = rng.permutation(100)[: 2 * N].reshape(N, 2)
    poses, states = random_poses(rng, N), rng.normal(0, 10, (N, dim))
    values = values_of(keys.T.ravel(), [*poses, *states])
    R = np.stack([covariance(rng, 2) for _ in range(N)])
    return (
        relative_detection_factors(keys, rng.normal(0, 10, (N, 3)), R, dim, position, robust),
        values,
        (poses, states),
    )


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("make", [odometry, sightings])
def test_jacobians_are_the_derivatives_of_the_residual(make, seed, covariance):
    factors, _, states = make(np.random.default_rng(seed), covariance)
    analytic = factors.jacobians(*states)
    variables = [SpatialPose() if s.shape[1:] == (4, 4) else Vector(s.shape[1]) for s in states]
    for row in range(N):

        def residual(*one, row=row):
            moved = [s.copy() for s in states]
            for column, state in zip(moved, one, strict=True):
                column[row] = state.matrix() if isinstance(state, gtsam.Pose3) else state
            return factors.residual(*moved)[row]

        here = [gtsam.Pose3(s[row]) if s.shape[1:] == (4, 4) else s[row] for s in states]
        for given, numerical in zip(analytic, central_differences(residual, here, variables), strict=True):
            np.testing.assert_allclose(given[row], numerical, atol=2e-7)


@pytest.mark.parametrize("make", [odometry, sightings])
def test_linear_factors_predict_the_error_after_a_small_step(make, covariance):
    rng = np.random.default_rng(9)
    factors, values, _ = make(rng, covariance)
    linear = factors.linearise(values)
    delta = gtsam.VectorValues()
    for key, dim in values.dims().items():
        delta.insert(key, 1e-6 * rng.normal(size=dim))
    predicted = linear.error(delta) - linear.error(gtsam.VectorValues.Zero(delta))
    actual = factors.error(values.retract(delta)) - factors.error(values)
    assert actual == pytest.approx(predicted, rel=1e-3)


def test_a_robust_loss_weighs_what_is_far_off(covariance):
    plain, values, _ = sightings(np.random.default_rng(0), covariance)
    robust, _, _ = sightings(np.random.default_rng(0), covariance, Robust("cauchy", 1.0))
    assert robust.error(values) < plain.error(values)


def test_odometry_without_errors_is_the_increment_between_two_poses():
    rng = np.random.default_rng(1)
    a, b = random_poses(rng, 2)
    step = np.linalg.inv(a) @ b
    factors = odometry_factors([[0, 1, 2, 3]], step[None], [0.5], np.eye(9))
    values = values_of([0, 1, 2, 3], [a, b, np.zeros(3), np.zeros(3)])
    assert factors.error(values) == pytest.approx(0.0, abs=1e-12)
    values.update(2, np.array([0.1, 0.2, 0.3]))  # 10 % too long, turned 0.1 rad too far, 0.3 to the left
    values.update(3, np.array([0.1, 0.2, 0.3]))
    true = step.copy()
    true[:3, :3] = rotation_exp(np.array([[0, 0, -0.1]]))[0] @ step[:3, :3]
    true[:3, 3] = rotation_exp(np.array([[0, 0, -0.3]]))[0] @ step[:3, 3] / 1.1
    values.update(1, gtsam.Pose3(a @ true))
    assert factors.error(values) == pytest.approx(0.0, abs=1e-12)


def test_noisy_increments_do_not_pull_at_the_scale():
    """With known motion the best scale is the true one, for any noise of the increments."""
    rng = np.random.default_rng(2)
    n = 2000
    poses = np.tile(np.eye(4), (n + 1, 1, 1))
    poses[:, 0, 3] = 0.1 * np.arange(n + 1)
    steps = np.linalg.inv(poses[:-1]) @ poses[1:]
    steps[:, :3, 3] = 1.05 * steps[:, :3, 3] + rng.normal(0, 0.1, (n, 3))
    errors = n + 1 + np.arange(n + 1)
    factors = odometry_factors(
        np.column_stack([np.arange(n), np.arange(1, n + 1), errors[:-1], errors[1:]]),
        steps,
        np.full(n, 0.1),
        np.diag([1e-4] * 3 + [1e-2] * 3 + [1e-10] * 3),
    )
    graph = nonlinear_graph(prior_factors([n + 1], np.zeros((1, 3)), np.diag([1.0, 1.0, 1e-8])), {n + 1: 3})
    known = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    for k in range(n + 1):
        graph.add(gtsam.PriorFactorPose3(k, gtsam.Pose3(poses[k]), known))
    start = values_of(range(2 * n + 2), [*poses, *np.zeros((n + 1, 3))])
    scale = solve(graph, [factors], start).values.atVector(n + 1)[0]
    assert scale == pytest.approx(0.05, abs=4 * 0.1 / (0.1 * np.sqrt(n)))


def test_pose_and_objects_are_recovered_together():
    """A vehicle that knows where it started and sees three objects that stand finds its scale error."""
    rng = np.random.default_rng(3)
    objects = np.array([[10.0, 4, 0, 0], [14.0, -6, 0, 0], [25.0, 3, 0, 0]])
    truth = [gtsam.Pose3(gtsam.Rot3.Yaw(0.05 * k), np.array([2.0 * k, 0.1 * k * k, 0.3])) for k in range(5)]
    step = np.stack([truth[k].between(truth[k + 1]).matrix() for k in range(4)])
    reported = step.copy()
    reported[:, :3, 3] *= 1.2
    poses, errors, names = range(5), range(5, 10), np.arange(10, 13)
    noise = np.diag([1e-6] * 3 + [1e-4] * 3 + [1e-8] * 3)
    odometry = odometry_factors(
        np.column_stack([poses[:-1], poses[1:], errors[:-1], errors[1:]]), reported, np.full(4, 0.5), noise
    )
    rows = np.array([[k, name] for k in poses for name in names])
    z = [truth[k].transformTo(np.append(objects[name - 10, :2], 1.0)) for k, name in rows]
    seen = relative_detection_factors(rows, z, 1e-4 * np.eye(2), 4)
    linear = prior_factors([5], np.zeros((1, 3)), np.eye(3)) + prior_factors(names, np.zeros((3, 4)), 1e4 * np.eye(4))
    graph = nonlinear_graph(linear, {5: 3, **dict.fromkeys(names.tolist(), 4)})
    graph.add(gtsam.PriorFactorPose3(0, truth[0], gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)))
    start = gtsam.Values()
    for k in poses:
        start.insert(k, truth[0])
        start.insert(5 + k, np.zeros(3))
    for name in names.tolist():
        start.insert(name, objects[name - 10] + np.append(rng.normal(0, 1, 2), [0, 0]))
    solution = solve(graph, [odometry, seen], start)
    assert solution.converged
    assert solution.values.atVector(9)[0] == pytest.approx(0.2, abs=1e-3)
    for k in poses:
        np.testing.assert_allclose(solution.values.atPose3(k).matrix(), truth[k].matrix(), atol=2e-3)
    for name in names.tolist():
        np.testing.assert_allclose(solution.values.atVector(name)[:2], objects[name - 10, :2], atol=2e-3)


def test_what_does_not_fit_is_refused():
    with pytest.raises(FactorError, match=r"dt\[0\]: expected seconds >= 0"):
        odometry_factors([[0, 1, 2, 3]], np.eye(4)[None], [-1.0], np.eye(9))
    with pytest.raises(FactorError, match="position: expected distinct components"):
        relative_detection_factors([[0, 1]], np.zeros((1, 3)), np.eye(2), 4, (0, 4))
    with pytest.raises(FactorError, match="jacobians: expected a function, since there are poses"):
        ResidualFactors([[0]], (SpatialPose(),), lambda pose: pose[:, :3, 3], np.eye(3))
    factors = relative_detection_factors([[0, 1]], np.zeros((1, 3)), np.eye(2), 4)
    with pytest.raises(FactorError, match="values has another type of variable in 0"):
        factors.error(values_of([0, 1], [np.zeros(6), np.zeros(4)]))


def test_maps_of_rotations():
    rng = np.random.default_rng(5)
    vectors = np.concatenate([rng.normal(0, 1, (6, 3)), [[0, 0, 0], [1e-9, 0, 0], [1e-3, -2e-3, 0]]])
    R = rotation_exp(vectors)
    for one, matrix in zip(vectors, R, strict=True):
        np.testing.assert_allclose(matrix, gtsam.Rot3.Expmap(one).matrix(), atol=1e-12)
    np.testing.assert_allclose(rotation_log(R), vectors, atol=1e-9)
    delta = 1e-6 * rng.normal(size=vectors.shape)
    moved = rotation_log(R @ rotation_exp(delta))
    expected = vectors + (inverse_right_jacobian(vectors) @ delta[:, :, None])[:, :, 0]
    np.testing.assert_allclose(moved, expected, atol=1e-10)
    np.testing.assert_allclose(cross_matrix(vectors[0]) @ vectors[1], np.cross(vectors[0], vectors[1]))

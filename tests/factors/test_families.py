"""Families of nonlinear factors: Jacobians against differences, residuals against equations, what is refused."""

import gtsam
import numpy as np
import pytest

from factors import (
    Bearing,
    FactorError,
    Polar,
    Radar,
    Range,
    RangeBearing,
    RangeRate,
    detection_factors,
    linearised,
    nonlinear_graph,
    odometry_factors,
    plane_factor,
    prior_factors,
    relative_factors,
    residual_factor,
    solve,
)
from factors.manifolds import cross_matrix, inverse_right_jacobian, rotation_exp, rotation_log

N = 3
POSE = (1.0, -2.0, 0.7)
POLAR = {
    "range and bearing": RangeBearing(4, (2, 0), POSE),
    "range": Range(4, (2, 0), POSE),
    "bearing": Bearing(5, (1, 4), POSE),
    "range rate": RangeRate(5, (0, 3), (4, 1), POSE, (0.5, -1.0)),
    "radar": Radar(4, (0, 1), (2, 3), POSE, (0.5, -1.0)),
}


def some_pose(rng, dim=3):
    if dim == 2:
        return gtsam.Pose2(*rng.normal(0, 5, 2), rng.uniform(-3, 3))
    return gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(0, 0.5, 3)), rng.normal(0, 5, 3))


def some_plane(rng):
    normal = rng.normal(size=3)
    return gtsam.OrientedPlane3(np.append(normal / np.linalg.norm(normal), rng.normal(0, 5)))


def random_poses(rng, n):
    return np.stack([gtsam.Pose3(gtsam.Rot3.Expmap(v), t).matrix() for v, t in rng.normal(0, 0.6, (n, 2, 3))])


def values_of(keys, states):
    values = gtsam.Values()
    for key, state in zip(keys, states, strict=True):
        is_pose = isinstance(state, np.ndarray) and state.shape == (4, 4)
        values.insert(int(key), gtsam.Pose3(state) if is_pose else state)
    return values


def seen(dim, state_dim=None, position=None, model=None):
    """Places seen from poses."""

    def make(rng, keys, covariance):
        place = tuple(range(dim)) if position is None else position
        m = (dim if len(place) == dim else 2) if model is None else model.dim
        z = rng.uniform(1, 5, (N, dim if model is None else m))
        R = np.stack([covariance(rng, m) for _ in range(N)])
        states = [[some_pose(rng, dim) for _ in range(N)], rng.normal(0, 5, (N, state_dim or dim))]
        return [relative_factors(keys, z, R, state_dim or dim, place, model=model)], states

    return make


def detection(model):
    def make(rng, keys, covariance):
        R = np.stack([covariance(rng, model.dim) for _ in range(N)])
        factors = detection_factors(keys[:, 0], model, rng.normal(size=(N, model.dim)), R)
        return [factors], [5 * rng.normal(size=(N, model.state_dim))]

    return make


def plane(rng, keys, covariance):
    poses, planes = [some_pose(rng) for _ in range(N)], [some_plane(rng) for _ in range(N)]
    held = [
        one.transform(pose.inverse()).retract(rng.normal(0, 0.2, 3)) for one, pose in zip(planes, poses, strict=True)
    ]
    coefficients = [one.planeCoefficients() for one in planes]
    made = [
        plane_factor(row[0], row[1], z, covariance(rng, 3)) for row, z in zip(keys.tolist(), coefficients, strict=True)
    ]
    return made, [poses, held]


def odometry(rng, keys, covariance):
    a, steps = random_poses(rng, N), random_poses(rng, N)
    b = a @ steps @ random_poses(rng, N)
    R = np.stack([covariance(rng, 9) for _ in range(N)])
    return [odometry_factors(keys, steps, rng.uniform(0.1, 2, N), R)], [a, b, *rng.normal(0, 0.1, (2, N, 3))]


CASES = {
    "point in the plane": seen(2), "point in space": seen(3), "object in the plane": seen(2, 5, (3, 1)),
    "object from a pose in space": seen(3, 5, (3, 1)), "plane": plane,
    "range and bearing from a pose": seen(2, 5, (3, 1), RangeBearing(2)), "odometry": odometry,
    **{f"detection, {name}": detection(model) for name, model in POLAR.items()},
}  # fmt: skip


def dense(factors, values, ordering):
    """Jacobian and right-hand side of all factors."""
    native = gtsam.NonlinearFactorGraph()
    for factor in factors:
        if isinstance(factor, gtsam.NonlinearFactor):
            native.add(factor)
    ours = [factor for factor in factors if not isinstance(factor, gtsam.NonlinearFactor)]
    return linearised(native, ours, values).jacobian(ordering)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", CASES)
def test_jacobians_are_those_of_central_differences(name, seed, covariance):
    rng = np.random.default_rng(seed)
    keys = rng.permutation(100)[: 4 * N].reshape(N, 4)[:, : 4 if name == "odometry" else 2]  # unsorted
    factors, states = CASES[name](rng, keys, covariance)
    values = values_of(keys[:, : len(states)].T.ravel(), [state for column in states for state in column])
    names = sorted(values.keys())
    A, _ = dense(factors, values, gtsam.Ordering(names))
    dims, column = values.dims(), 0
    for key in names:
        for i in range(dims[key]):
            ends = []
            for size in (1e-6, -1e-6):
                step = gtsam.VectorValues()
                for other, dim in dims.items():
                    step.insert(other, size * np.eye(dim)[i] if other == key else np.zeros(dim))
                ends.append(-dense(factors, values.retract(step), gtsam.Ordering(names))[1])
            np.testing.assert_allclose(A[:, column], (ends[0] - ends[1]) / 2e-6, rtol=1e-5, atol=3e-6)
            column += 1
    assert column == A.shape[1]


@pytest.mark.parametrize("seed", range(3))
def test_a_perfect_measurement_costs_nothing(seed):
    rng = np.random.default_rng(seed)
    pose, place, wall = some_pose(rng), rng.normal(0, 5, 3), some_plane(rng)
    values, here = values_of([1, 2, 3], [pose, place, wall]), pose.transformTo(place)
    errors = [
        relative_factors([[1, 2]], [here], np.eye(3), 3, (0, 1, 2)).error(values),
        relative_factors([[1, 2]], [here], np.eye(2), 3).error(values),
        plane_factor(1, 3, wall.transform(pose).planeCoefficients(), np.eye(3)).error(values),
    ]
    np.testing.assert_allclose(errors, 0, atol=1e-18)


def test_polar_measurements_of_a_known_scene_and_across_the_cut():
    x = np.array([1.0, 1.0, 2.0, 3.0])  # three metres to the left of a sensor that looks along x
    radar = Radar(4, sensor_pose=(1.0, -2.0, 0.0), sensor_velocity=(9.0, 1.0))
    np.testing.assert_allclose(radar.predict(x), [3.0, np.pi / 2, 2.0])
    np.testing.assert_allclose(RangeBearing(4, sensor_pose=(1.0, -2.0, np.pi / 2)).predict(x), [3.0, 0.0], atol=1e-15)
    values = values_of([1], [np.array([-10.0, -0.01])])
    error = detection_factors([1], RangeBearing(2), [[10.0, np.pi - 0.001]], np.eye(2)).error(values)
    assert error == pytest.approx(0.5 * 0.002**2, rel=1e-2)
    numerical = residual_factor([1], [2], RangeBearing(2).predict, np.eye(2), angles=(1,))
    J = numerical.linearise(values_of([1], [np.array([-10.0, 0.0])])).at(0).jacobian()[0]
    np.testing.assert_allclose(J, [[-1.0, 0.0], [0.0, -0.1]], atol=1e-8)


def test_range_and_bearing_are_gtsams_own_factor():
    """From a known sensor, and from a pose of the graph; range and bearing alone cost what they cost together."""
    pose, point, z, R = gtsam.Pose2(*POSE), np.array([6.0, 3.0]), np.array([9.0, 0.2]), np.diag([0.3, 0.05]) ** 2
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.05, 0.3]))
    values = values_of([1, 2], [pose, point])
    theirs = gtsam.BearingRangeFactor2D(1, 2, gtsam.Rot2(z[1]), z[0], noise).error(values)
    assert detection_factors([2], RangeBearing(2, sensor_pose=POSE), [z], R).error(values) == pytest.approx(theirs)
    assert relative_factors([[1, 2]], [z], R, 2, model=RangeBearing(2)).error(values) == pytest.approx(theirs)
    alone = [
        relative_factors([[1, 2]], [z[:1]], R[:1, :1], 2, model=Range(2)).error(values),
        relative_factors([[1, 2]], [z[1:]], R[1:, 1:], 2, model=Bearing(2)).error(values),
    ]
    assert sum(alone) == pytest.approx(theirs)


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
    graph = nonlinear_graph(prior_factors([n + 1], np.zeros((1, 3)), np.diag([1.0, 1.0, 1e-8])).native(), {n + 1: 3})
    known = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    for k in range(n + 1):
        graph.add(gtsam.PriorFactorPose3(k, gtsam.Pose3(poses[k]), known))
    start = values_of(range(2 * n + 2), [*poses, *np.zeros((n + 1, 3))])
    scale = solve(graph, [factors], start).values.atVector(n + 1)[0]
    assert scale == pytest.approx(0.05, abs=4 * 0.1 / (0.1 * np.sqrt(n)))


THERE = Bearing(4, sensor_pose=(1.0, 1.0, 0.0))


def linearised_there(factors):
    values = values_of([0, 1], [gtsam.Pose2(1, 1, 0), np.array([1.0, 1.0, 0.0, 0.0])])
    return factors.linearise(values)


def test_what_does_not_fit_is_refused(subtests):
    for make, message in [
        (lambda: plane_factor(1, 2, [0, 0, 2, 1], np.eye(3)), "length 1"),
        (lambda: plane_factor(1, 1, [0, 0, 1, 1], np.eye(3)), "occurs twice"),
        (lambda: plane_factor(1, 2, [0, 0, 1, 1], np.eye(4)), "covariance"),
        (lambda: relative_factors([[1, 2]], [[1, 2]], np.eye(3), 2), "covariances"),
        (lambda: relative_factors([[1, 1]], [[1, 2]], np.eye(2), 2), "occurs twice"),
        (lambda: relative_factors([[0, 1]], [[1, 2, 3]], np.eye(2), 4, (0, 4)), "components from 0 to 3"),
        (lambda: relative_factors([[0, 1]], [[1, 2]], np.eye(2), 4, (1, 1)), "distinct"),
        (lambda: relative_factors([[0, 1]], [[0, 0.1]], np.eye(2), 4, model=RangeBearing(2)), "expected ranges > 0"),
        (lambda: relative_factors([[0, 1]], [[1.0]], np.eye(1), 4, model=Range(4)), "in the plane or in space"),
        (lambda: odometry_factors([[0, 1, 2, 3]], np.eye(4)[None], [-1.0], np.eye(9)), "expected seconds >= 0"),
        (lambda: Polar(4, ("range",), (0, 1, 2)), "two components"),
        (lambda: RangeBearing(4, sensor_pose=(0.0, 0.0)), "sensor_pose"),
        (lambda: RangeRate(4, (0, 1), (1, 2)), "distinct"),
        (lambda: detection_factors([0], Range(4), [[1.0, 2.0]], np.eye(1)), "z: expected shape"),
        (lambda: detection_factors([0], Range(4), [[np.nan]], np.eye(1)), "finite"),
        (lambda: detection_factors([0, 1], Range(4), [[1.0]], np.eye(1)), "z: expected shape"),
        (lambda: linearised_there(detection_factors([1], THERE, [[1.0]], [[1.0]])), "at the sensor"),
        (lambda: linearised_there(relative_factors([[0, 1]], [[1.0]], [[1.0]], 4, model=Bearing(2))), "at the sensor"),
        (lambda: linearised_there(relative_factors([[0, 1]], [[1, 2, 3]], np.eye(2), 4)), "another type of variable"),
    ]:
        with subtests.test(message), pytest.raises(FactorError, match=message):
            make()


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

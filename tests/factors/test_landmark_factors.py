"""Factors on landmarks, lanes and the ground: Jacobians against differences, residuals against the equations."""

import gtsam
import numpy as np
import pytest

from factors import (
    FactorError,
    HesseLine,
    OrientedPlane,
    PlanarPose,
    Robust,
    SpatialPose,
    Vector,
    attitude_factor,
    bearing_range_factor,
    lane_boundary_factors,
    lane_keeping_factors,
    line_factors,
    on_plane_factor,
    plane_factor,
    point_factors,
    position_factor,
    range_factor,
    relative_detection_factors,
)
from factors.solver import linearised

SEEDS = range(5)
CURVE = gtsam.Pose3(gtsam.Rot3.Yaw(0.7), np.array([3.0, -2.0, 0.5])).matrix()

TILTED = gtsam.Pose3(gtsam.Rot3.Roll(1.0), np.zeros(3)).matrix()


def some_pose(rng, dim=3):
    if dim == 2:
        return gtsam.Pose2(*rng.normal(0, 5, 2), rng.uniform(-3, 3))
    return gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(0, 0.5, 3)), rng.normal(0, 5, 3))


def some_plane(rng):
    normal = rng.normal(size=3)
    return gtsam.OrientedPlane3(np.append(normal / np.linalg.norm(normal), rng.normal(0, 5)))


def point(dim):
    def make(rng, keys, covariance):
        factor = point_factors([keys], rng.normal(0, 5, (1, dim)), covariance(rng, dim))
        return factor, [some_pose(rng, dim), rng.normal(0, 5, dim)]

    return make


def plane(rng, keys, covariance):
    seen = some_plane(rng)
    pose = some_pose(rng)
    held = seen.transform(pose.inverse()).retract(rng.normal(0, 0.2, 3))
    return plane_factor(*keys, seen.planeCoefficients(), covariance(rng, 3)), [pose, held]  # type: ignore[call-arg]


def distance(planar):
    def make(rng, keys, covariance):
        factor = range_factor(*keys, rng.uniform(1, 9), 0.3, planar, Robust("huber", 100.0))  # type: ignore[call-arg]
        dim = 2 if planar else 3
        return factor, [some_pose(rng, dim), rng.normal(0, 5, dim)]

    return make


def bearing(planar):
    def make(rng, keys, covariance):
        dim = 2 if planar else 3
        pose, place = some_pose(rng, dim), rng.normal(0, 5, dim)
        off = 0.3 if planar else 0.0  # GTSAM neglects the curvature of the sphere of directions
        towards = pose.transformTo(place) + rng.normal(0, off, dim)
        angle = np.arctan2(towards[1], towards[0]) if planar else towards / np.linalg.norm(towards)
        return bearing_range_factor(*keys, angle, 4.0, covariance(rng, dim)), [pose, place]  # type: ignore[call-arg]

    return make


def satellite(dim):
    def make(rng, keys, covariance):
        antenna = rng.normal(0, 2, 3)
        return position_factor(keys[0], rng.normal(0, 5, dim), covariance(rng, dim), antenna), [some_pose(rng, dim)]

    return make


def attitude(rng, keys, covariance):
    return attitude_factor(keys[0], np.array([0.1, -0.2, 2.0]), 0.04), [some_pose(rng)]


def boundary(rng, keys, covariance):
    factor = lane_boundary_factors([keys], rng.normal(0, 5, (1, 3)), 0.3, CURVE, 4, offsets=1.5)
    return factor, [some_pose(rng), rng.normal(0, [1, 0.3, 0.02, 0.002])]


def keeping(rng, keys, covariance):
    factor = lane_keeping_factors([keys], 0.3, CURVE, 3, state_dim=5, position=(3, 1), offsets=[-0.5])
    return factor, [rng.normal(0, 5, 5), rng.normal(0, [1, 0.3, 0.02])]


def edge(rng, keys, covariance):
    factor = line_factors([keys], rng.normal(0, 5, (1, 2, 3)), covariance(rng, 2))
    return factor, [some_pose(rng), np.array([rng.uniform(-3, 3), rng.normal(0, 5)])]


def keeping_bend(rng, keys, covariance):
    curve = gtsam.Pose3(gtsam.Rot3.Yaw(rng.uniform(-3, 3)), rng.normal(0, 5, 3)).matrix()
    factor = lane_keeping_factors([keys], 0.3, [curve], 1, state_dim=4)
    return factor, [rng.normal(0, 5, 4), rng.normal(0, 1, 1)]


def standing(rng, keys, covariance):
    return on_plane_factor(*keys, 0.8, 0.01, state_dim=6, position=(4, 0, 2)), [rng.normal(0, 5, 6), some_plane(rng)]  # type: ignore[call-arg]


def detection(rng, keys, covariance):
    factor = relative_detection_factors([keys], rng.normal(0, 5, (1, 2)), covariance(rng, 2), 5, (3, 1))
    return factor, [some_pose(rng, 2), rng.normal(0, 5, 5)]


CASES = {
    "point in the plane": point(2), "point in space": point(3), "plane": plane, "range in the plane": distance(True),
    "range in space": distance(False), "bearing in the plane": bearing(True), "bearing in space": bearing(False),
    "position in the plane": satellite(2), "position in space": satellite(3),
    "attitude": attitude, "lane boundary": boundary, "lane keeping": keeping,
    "lane keeping, seen at each foot": keeping_bend, "on a plane": standing, "straight edge": edge,
    "object in the plane": detection,
}  # fmt: skip


def values_of(keys, states):
    values = gtsam.Values()
    for key, state in zip(keys, states, strict=False):
        values.insert(key, state)
    return values


def variable(state):
    kinds = {gtsam.Pose2: PlanarPose(), gtsam.Pose3: SpatialPose(), gtsam.OrientedPlane3: OrientedPlane()}
    return kinds.get(type(state)) or Vector(len(state))


def row(factor, values):
    """The factor as one linear one."""
    native = gtsam.NonlinearFactorGraph()
    ours = [factor]
    if isinstance(factor, gtsam.NonlinearFactor):
        native.add(factor)
        ours = []
    linear = linearised(native, ours, values)
    assert linear.size() == 1
    return linear.at(0)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("seed", SEEDS)
def test_jacobians_are_those_of_central_differences(name, seed, covariance):
    rng = np.random.default_rng(seed)
    keys = [9, 2] if seed % 2 else [2, 9]
    factor, states = CASES[name](rng, keys, covariance)
    values = values_of(keys, states)
    linear = row(factor, values)
    A, _ = linear.jacobian()
    column = 0
    for key in tuple(linear.keys()):
        state = states[keys.index(key)]
        kind = variable(state)
        for i in range(kind.dim):
            ends = []
            for sign in (1, -1):
                moved = list(states)
                moved[keys.index(key)] = kind.retract(state, sign * 1e-6 * np.eye(kind.dim)[i])
                ends.append(-row(factor, values_of(keys, moved)).jacobian()[1])
            np.testing.assert_allclose(A[:, column], (ends[0] - ends[1]) / 2e-6, rtol=1e-5, atol=2e-6)
            column += 1
    assert column == A.shape[1]


@pytest.mark.parametrize("seed", SEEDS)
def test_a_perfect_measurement_costs_nothing(seed):
    rng = np.random.default_rng(seed)
    pose, place, wall = some_pose(rng), rng.normal(0, 5, 3), some_plane(rng)
    values = values_of([1, 2, 3], [pose, place, wall])
    seen = pose.transformTo(place)
    up = pose.rotation().matrix().T @ [0, 0, 1]
    c = np.array([0.3, 0.1, 0.01])
    values.insert(4, c)
    x = rng.normal(0, 5)
    f, slope = np.polyval(c[::-1], x), c[1] + 2 * c[2] * x
    beside = np.array([x, f]) + 1.5 * np.array([-slope, 1]) / np.hypot(1, slope)
    beyond = CURVE[:3, :3] @ [x, f, 0.0] + CURVE[:3, 3]
    values.insert(5, (CURVE[:2, :2] @ beside + CURVE[:2, 3]))
    errors = [
        point_factors([[1, 2]], [seen], np.eye(3)).error(values),
        plane_factor(1, 3, wall.transform(pose).planeCoefficients(), np.eye(3)).error(values),
        range_factor(1, 2, np.linalg.norm(seen), 1.0, planar=False).error(values),
        bearing_range_factor(1, 2, seen / np.linalg.norm(seen), np.linalg.norm(seen), np.eye(3)).error(values),
        position_factor(1, pose.translation(), np.eye(3)).error(values),
        attitude_factor(1, 3 * up, 1.0).error(values),
        lane_boundary_factors([[1, 4]], [pose.transformTo(beyond)], 1.0, CURVE, 3).error(values),
        on_plane_factor(2, 3, wall.normal().point3() @ place + wall.distance(), 1.0, 3).error(values),
    ]
    np.testing.assert_allclose(errors, 0, atol=1e-18)


@pytest.mark.parametrize("seed", SEEDS)
def test_lines_are_compared_whatever_they_are_written_as(seed):
    rng = np.random.default_rng(seed)
    kind, line = HesseLine(), np.array([rng.uniform(-9, 9), rng.normal(0, 5)])
    step = np.array([rng.uniform(-1.5, 1.5), rng.normal()])
    theta, rho = kind.retract(line, step)
    for same in ((theta, rho), (theta - 2 * np.pi, rho), (theta + np.pi, -rho), (theta - 3 * np.pi, -rho)):
        np.testing.assert_allclose(kind.local(line, np.array(same)), step, atol=1e-12)


def test_the_offset_of_a_straight_lane_is_a_distance():
    values = values_of([1, 2], [np.array([10.0, 4.0]), np.array([1.0, 0.0])])
    factor = lane_keeping_factors([[1, 2]], 1.0, np.eye(4), 2, state_dim=2, offsets=1.0)
    assert factor.error(values) == pytest.approx(0.5 * 2.0**2)


def test_what_would_crash_gtsam_is_refused(subtests):
    for make, message in [
        (lambda: plane_factor(1, 2, [0, 0, 2, 1], np.eye(3)), "length 1"),
        (lambda: plane_factor(1, 2, [0, 0, 1], np.eye(3)), "shape"),
        (lambda: plane_factor(1, 1, [0, 0, 1, 1], np.eye(3)), "more than once"),
        (lambda: plane_factor(1, 2, [0, 0, 1, 1], np.eye(4)), "covariance"),
        (lambda: range_factor(1, 2, -1.0, 1.0, planar=True), "distance: expected a number > 0"),
        (lambda: range_factor(1, 2, np.nan, 1.0, planar=True), "finite"),
        (lambda: range_factor(1, 2, 1.0, 0.0, planar=True), "positive definite"),
        (lambda: bearing_range_factor(1, 2, [1, 1, 1], 1.0, np.eye(3)), "direction of length 1"),
        (lambda: bearing_range_factor(1, 2, 0.5, 1.0, np.eye(3)), "covariance"),
        (lambda: position_factor(1, [1, 2, 3, 4], np.eye(4)), "position: expected 2 or 3"),
        (lambda: attitude_factor(1, [0, 0, 0], 1.0), "seen: expected a direction"),
        (lambda: attitude_factor(1, [0, 0, 1], -1.0), "positive definite"),
        (lambda: point_factors([[1, 2]], [[1, 2]], np.eye(3)), "covariances"),
        (lambda: point_factors([[1, 1]], [[1, 2]], np.eye(2)), "occurs twice"),
        (lambda: lane_boundary_factors([[1, 2]], [[1, 2, 3]], 1.0, CURVE, 0), "coefficients"),
        (lambda: lane_boundary_factors([[1, 2]], [[1, 2, 3]], [1.0, 2.0], CURVE, 3), "variances"),
        (
            lambda: lane_boundary_factors([[1, 2]], [[1, 2, 3]], 1, TILTED, 3),
            "level",
        ),
        (lambda: lane_keeping_factors([[1, 2]], 1.0, CURVE, 3, state_dim=1), "position"),
        (lambda: lane_keeping_factors([[1, 2]], 1.0, [CURVE, CURVE], 3, state_dim=4), "world_T_curve"),
        (lambda: on_plane_factor(1, 2, np.inf, 1.0, 3), "height"),
    ]:  # fmt: skip
        with subtests.test(message), pytest.raises(FactorError, match=message):
            make()

"""Measurement models of places in the frame of a pose."""

import gtsam
import numpy as np
import pytest

from factors import (
    Bearing,
    FactorError,
    PlanarPose,
    Range,
    Vector,
    position,
    relative_factors,
    relative_range_bearing_factors,
)
from factors.manifolds import central_differences


@pytest.mark.parametrize("seed", range(5))
def test_jacobians_are_the_derivatives(seed):
    rng = np.random.default_rng(seed)
    pose, x = gtsam.Pose2(*rng.normal(size=3)), 5 * rng.normal(size=5)
    factors = relative_range_bearing_factors([[7, 3]], [[4.0, 0.3]], np.diag([0.1, 0.01]), 5, position=(3, 1))

    def residual(pose, x):
        return factors.residual(pose.matrix()[None], x[None])[0]

    expected = central_differences(residual, [pose, x], [PlanarPose(), Vector(5)])
    for mine, numerical in zip(factors.jacobians(pose.matrix()[None], x[None]), expected, strict=True):
        np.testing.assert_allclose(mine[0], numerical, atol=1e-8)


def test_it_is_gtsams_factor_on_a_state():
    pose, x, z = gtsam.Pose2(1.0, 2.0, 0.5), np.array([4.0, 3.0, 0.0, 0.0]), np.array([3.0, 0.1])
    values, noise = gtsam.Values(), gtsam.noiseModel.Diagonal.Sigmas(np.array([0.02, 0.3]))
    values.insert(0, pose)
    values.insert(1, x)
    mine = relative_range_bearing_factors([[0, 1]], [z], np.diag([0.3, 0.02]) ** 2, 4).error(values)
    values.update(1, x[:2])
    assert mine == pytest.approx(gtsam.BearingRangeFactor2D(0, 1, gtsam.Rot2(z[1]), z[0], noise).error(values))


def test_what_has_no_direction_is_refused():
    with pytest.raises(FactorError, match="expected ranges > 0"):
        relative_range_bearing_factors([[0, 1]], [[0.0, 0.1]], np.eye(2), 4)
    values = gtsam.Values()
    values.insert(0, gtsam.Pose2(1, 1, 0))
    values.insert(1, np.array([1.0, 1.0, 0.0, 0.0]))
    with pytest.raises(FactorError, match="at the sensor itself"):
        relative_range_bearing_factors([[0, 1]], [[1.0, 0.1]], np.eye(2), 4).error(values)


def test_any_model_is_seen_from_a_pose():
    """Range and bearing alone cost what they cost together."""
    values, R = gtsam.Values(), np.diag([0.3, 0.02]) ** 2
    values.insert(0, gtsam.Pose2(1.0, 2.0, 0.5))
    values.insert(1, np.array([4.0, 3.0, 0.0, 0.0]))
    both = relative_range_bearing_factors([[0, 1]], [[3.0, 0.1]], R, 4).error(values)
    range_ = relative_factors([[0, 1]], Range(2), [[3.0]], R[:1, :1], 4).error(values)
    bearing = relative_factors([[0, 1]], Bearing(2), [[0.1]], R[1:, 1:], 4).error(values)
    assert both == pytest.approx(range_ + bearing)
    with pytest.raises(FactorError, match="in the plane or in space"):
        relative_factors([[0, 1]], position(4), [[1.0, 2.0]], np.eye(2), 4)

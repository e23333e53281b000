"""Angles of a residual that are not wrapped are found, and nothing else is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
import pytest

from factors import PlanarPose, ResidualFactors, SpatialPose, Vector, residual_factor, unwrapped_angles

POINT = np.array([3.0, -4.0])


def seen(pose: gtsam.Pose2, measured: float = 0.4) -> np.ndarray:
    """Distance, and bearing less the measured one."""
    local = pose.transformTo(POINT)
    return np.array([np.hypot(*local) - 5.0, np.arctan2(local[1], local[0]) - measured])


def wrapped(pose: gtsam.Pose2) -> np.ndarray:
    distance, bearing = seen(pose)
    return np.array([distance, (bearing + np.pi) % (2 * np.pi) - np.pi])


@pytest.mark.parametrize(
    ("residual", "angles", "expected"),
    [
        (seen, (), (1,)),
        (seen, (1,), ()),
        (wrapped, (), ()),
        (lambda pose: [pose.theta() - 1.0], (), (0,)),
        (lambda pose: [np.rad2deg(pose.theta()) - 40.0], (), (0,)),
        (lambda pose: pose.transformTo(POINT), (), ()),
        (lambda pose: [1e3 * (pose.transformTo(POINT)[0] > 0)], (), ()),  # a jump, but not by a full turn
    ],
)
def test_a_component_that_jumps_by_a_full_turn_is_an_angle(
    residual: Callable[[Any], Any], angles: tuple[int, ...], expected: tuple[int, ...]
) -> None:
    state, values = gtsam.Pose2(0.3, 0.2, 2.0), gtsam.Values()
    values.insert(7, state)
    size = len(np.atleast_1d(residual(state)))
    factor = residual_factor((7,), (PlanarPose(),), residual, np.eye(size), angles=angles)
    assert unwrapped_angles(factor, values) == expected

    def of_matrices(poses: np.ndarray) -> np.ndarray:
        return np.array([residual(gtsam.Pose2(T[0, 2], T[1, 2], np.arctan2(T[1, 0], T[0, 0]))) for T in poses])

    jacobians = [np.zeros((1, size, 3))]
    stack = ResidualFactors([[7]], (PlanarPose(),), of_matrices, np.eye(size), lambda _: jacobians, angles=angles)
    assert unwrapped_angles(stack, values) == expected


def test_a_pose_in_space_turns_about_its_vertical_while_the_others_stand() -> None:
    def bearing(pose: gtsam.Pose3, point: np.ndarray) -> list[float]:
        x, y, _ = pose.transformTo(point)
        return [np.arctan2(y, x) - 0.5]

    factor = residual_factor((1, 2), (SpatialPose(), Vector(3)), bearing, [[0.01]])
    values = gtsam.Values()
    values.insert(1, gtsam.Pose3())
    values.insert(2, np.array([5.0, 1.0, 2.0]))
    assert unwrapped_angles(factor, values) == (0,)


def test_a_residual_that_is_undefined_elsewhere_is_left_alone() -> None:
    def ahead(pose: gtsam.Pose2) -> list[float]:
        local = pose.transformTo(POINT)
        if local[0] < 0:
            raise ValueError("behind the camera")
        return [local[1] / local[0]]

    factor = residual_factor((1,), (PlanarPose(),), ahead, [[1.0]])
    values = gtsam.Values()
    values.insert(1, gtsam.Pose2(0, 0, -0.9))
    assert unwrapped_angles(factor, values) == ()

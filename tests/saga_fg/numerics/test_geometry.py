"""Rigid transforms, angles and quaternions: laws, and known cases."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from saga_fg import InputError
from saga_fg.numerics.geometry import (
    adjoint,
    carried_covariance,
    checked_quaternions,
    checked_transform,
    inverse_transform,
    is_rotation,
    quaternion_rotation,
    quaternion_yaw,
    transform_points,
    wrap_angle,
    yaw_of,
    yaw_quaternion,
    yaw_transform,
)

angles = st.floats(-1e4, 1e4)
lengths = st.floats(-1e6, 1e6)


@st.composite
def rotations(draw):
    seed = draw(st.integers(0, 2**32 - 1))
    return Rotation.random(random_state=np.random.default_rng(seed))


@st.composite
def transforms(draw):
    T = np.eye(4)
    T[:3, :3] = draw(rotations()).as_matrix()
    T[:3, 3] = draw(arrays(np.float64, 3, elements=lengths))
    return T


@given(angles)
def test_wrapped_angles_lie_in_one_turn_and_point_the_same_way(angle):
    wrapped = float(wrap_angle(angle))
    assert -np.pi <= wrapped < np.pi
    assert np.allclose([np.cos(wrapped), np.sin(wrapped)], [np.cos(angle), np.sin(angle)], atol=1e-9)


def test_angles_at_the_seam(subtests):
    for angle, wrapped in [
        (np.pi, -np.pi),
        (-np.pi, -np.pi),
        (np.nextafter(-np.pi, -4), -np.pi),  # rounds to +pi unless told otherwise
        (3 * np.pi / 2, -np.pi / 2),
        (0.0, 0.0),
    ]:
        with subtests.test(angle=angle, wrapped=wrapped):
            assert float(wrap_angle(angle)) == pytest.approx(wrapped, abs=1e-12)
            assert -np.pi <= float(wrap_angle(angle)) < np.pi


def test_unknown_angles_stay_unknown_and_shapes_are_kept():
    assert np.isnan(wrap_angle([np.nan])).all()
    assert wrap_angle(np.zeros((2, 0))).shape == (2, 0)


@given(transforms())
def test_the_inverse_transform_undoes(T):
    assert np.allclose(inverse_transform(T) @ T, np.eye(4), atol=1e-8)
    assert np.array_equal(inverse_transform(np.stack([T, T]))[1], inverse_transform(T))


@given(transforms(), arrays(np.float64, (3, 3), elements=lengths))
def test_points_there_and_back(T, points):
    back = transform_points(inverse_transform(T), transform_points(T, points))
    assert np.allclose(back, points, atol=1e-8)


def test_a_transform_maps_its_source_to_its_target():
    world_T_ego = yaw_transform(x=10.0, y=5.0, z=1.0, yaw=np.pi / 2)  # facing along y
    ahead_left_of_ego = np.array([[2.0, 1.0, 0.5]])
    assert transform_points(world_T_ego, ahead_left_of_ego) == pytest.approx(np.array([[9.0, 7.0, 1.5]]))


@given(st.floats(-3.14, 3.14), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))
def test_yaw_of_a_tilted_vehicle_is_that_of_its_nose(yaw, pitch, roll):
    R = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    assert float(yaw_of(R)) == pytest.approx(yaw)


@given(arrays(np.float64, 4, elements=st.floats(-3.14, 3.14)))
def test_yaw_to_quaternion_and_back(yaw):
    quaternions = yaw_quaternion(yaw)
    assert np.allclose(np.linalg.norm(quaternions, axis=1), 1)
    assert np.allclose(quaternion_yaw(quaternions), yaw, atol=1e-12)
    assert np.allclose(quaternion_rotation(quaternions), [yaw_transform(yaw=a)[:3, :3] for a in yaw])


@given(rotations())
def test_quaternions_mean_what_scipy_means(rotation):
    quaternion = rotation.as_quat(scalar_first=True)
    assert np.allclose(quaternion_rotation(quaternion), rotation.as_matrix(), atol=1e-12)
    assert np.allclose(quaternion_yaw(quaternion), yaw_of(rotation.as_matrix()), atol=1e-9)
    assert np.allclose(quaternion_rotation(-quaternion), rotation.as_matrix(), atol=1e-12)


@given(transforms())
def test_rigid_transforms_are_accepted(T):
    assert np.array_equal(checked_transform("world_T_ego", T), T)


def broken(row, column, value):
    T = np.eye(4)
    T[row, column] = value
    return T


def test_what_is_not_rigid_is_refused(subtests):
    for value, message in [
        (np.diag([1.0, 1.0, -1.0, 1.0]), "world_T_ego: expected a rigid 4 x 4 transform"),  # a mirror
        (np.diag([2.0, 2.0, 2.0, 1.0]), "world_T_ego: expected a rigid 4 x 4 transform"),
        (broken(0, 1, 0.1), "world_T_ego: expected a rigid 4 x 4 transform"),
        (broken(3, 0, 1.0), "world_T_ego: expected a rigid 4 x 4 transform"),
        (np.zeros((4, 4)), "world_T_ego: expected a rigid 4 x 4 transform"),
        (np.eye(3), r"world_T_ego: expected shape \(4, 4\), got \(3, 3\)"),
        (broken(0, 3, np.nan), r"world_T_ego\[0, 3\]: expected a finite number, got nan"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            checked_transform("world_T_ego", value)


def test_quaternions_are_normalised_when_nearly_unit_and_refused_otherwise():
    nearly = np.array([[1.0005, 0.0, 0.0, 0.0]])
    assert checked_quaternions("rotation", nearly).tolist() == [[1.0, 0.0, 0.0, 0.0]]
    with pytest.raises(InputError, match=r"rotation\[1\]: expected a unit quaternion \(w, x, y, z\), got norm 0.5"):
        checked_quaternions("rotation", [[1.0, 0.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.0]])
    with pytest.raises(InputError, match=r"rotation: expected shape \(any, 4\)"):
        checked_quaternions("rotation", [[1.0, 0.0, 0.0]])
    assert checked_quaternions("rotation", []).shape == (0, 4)


def test_a_matrix_whose_determinant_underflows_is_no_rotation() -> None:
    assert not is_rotation(np.array([[1.0, 0, 0], [0, 0, 1], [0, 1e-320, 1]]), 1e-4)


def test_adjoints_are_those_of_gtsam_and_carry_covariances():
    rng = np.random.default_rng(0)
    poses = [gtsam.Pose3.Expmap(rng.normal(size=6)) for _ in range(4)]
    Ad = adjoint(np.array([pose.matrix() for pose in poses]))
    np.testing.assert_allclose(Ad, [pose.AdjointMap() for pose in poses], atol=1e-12)
    A = rng.normal(size=(6, 6))
    np.testing.assert_allclose(carried_covariance(poses[1].matrix(), A @ A.T), Ad[1] @ A @ A.T @ Ad[1].T, atol=1e-12)
    assert adjoint(np.empty((0, 4, 4))).shape == (0, 6, 6)

"""Geometry and arrays. Rigid transforms, angles and quaternions: laws, and known cases."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from scipy.spatial.transform import Rotation

from saga_fg import InputError, SagaError
from saga_fg.numerics.arrays import checked, checked_covariances, checked_ids, checked_labels
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


def test_transforms_map_sources_to_targets_and_unknown_angles_stay_unknown():
    assert np.isnan(wrap_angle([np.nan])).all()
    assert wrap_angle(np.zeros((2, 0))).shape == (2, 0)
    world_T_ego = yaw_transform(x=10.0, y=5.0, z=1.0, yaw=np.pi / 2)  # facing along y
    ahead_left_of_ego = np.array([[2.0, 1.0, 0.5]])
    assert transform_points(world_T_ego, ahead_left_of_ego) == pytest.approx(np.array([[9.0, 7.0, 1.5]]))
    assert not is_rotation(np.array([[1.0, 0, 0], [0, 0, 1], [0, 1e-320, 1]]), 1e-4)


@given(transforms())
def test_rigid_transforms_are_accepted_and_undone_by_their_inverses(T):
    assert np.allclose(inverse_transform(T) @ T, np.eye(4), atol=1e-8)
    assert np.array_equal(inverse_transform(np.stack([T, T]))[1], inverse_transform(T))
    assert np.array_equal(checked_transform("world_T_ego", T), T)


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


def test_adjoints_are_those_of_gtsam_and_carry_covariances():
    rng = np.random.default_rng(0)
    poses = [gtsam.Pose3.Expmap(rng.normal(size=6)) for _ in range(4)]
    Ad = adjoint(np.array([pose.matrix() for pose in poses]))
    np.testing.assert_allclose(Ad, [pose.AdjointMap() for pose in poses], atol=1e-12)
    A = rng.normal(size=(6, 6))
    np.testing.assert_allclose(carried_covariance(poses[1].matrix(), A @ A.T), Ad[1] @ A @ A.T @ Ad[1].T, atol=1e-12)
    assert adjoint(np.empty((0, 4, 4))).shape == (0, 6, 6)


# Arrays are converted, checked and frozen at the door; what is wrong is named


@given(arrays(np.float64, array_shapes(max_dims=3), elements=st.floats(allow_nan=False, allow_infinity=False)))
def test_finite_arrays_pass_unchanged_as_read_only_copies(values):
    result = checked("values", values, values.shape)
    assert np.array_equal(result, values)
    assert result.dtype == np.float64
    assert not result.flags.writeable
    assert not np.shares_memory(result, values)


def test_lists_integers_and_nothing_become_floats(subtests):
    assert checked("values", [[1, 2], [3, 4]], (None, 2)).tolist() == [[1.0, 2.0], [3.0, 4.0]]
    for shape in [(None, 3), (None, 2, 2), (None,)]:
        with subtests.test(shape=shape):
            assert checked("values", [], shape).shape == tuple(n or 0 for n in shape)


def test_wrong_arrays_are_named(subtests):
    for value, shape, message in [
        ([1.0, 2.0], (3,), r"speed: expected shape \(3,\), got \(2,\)"),
        ([[1.0, 2.0]], (None, 3), r"speed: expected shape \(any, 3\), got \(1, 2\)"),
        (1.0, (None,), r"speed: expected shape \(any,\), got \(\)"),
        (["fast"], (1,), r"speed: expected numbers, got \['fast'\]"),
        ([[1.0], [1.0, 2.0]], (2, None), "speed: expected numbers, got"),
        ([10**400], (1,), "speed: expected numbers, got"),
        ([1j], (1,), "speed: expected numbers, got"),
        ([0.0, np.nan], (2,), r"speed\[1\]: expected a finite number, got nan"),
        ([[0.0, 0.0], [np.inf, 0.0]], (2, 2), r"speed\[1, 0\]: expected a finite number, got inf"),
        ([None], (1,), r"speed\[0\]: expected a finite number, got nan"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            checked("speed", value, shape)


def test_complex_numbers_are_refused_and_nan_is_let_in_only_where_it_means_unknown():
    with pytest.raises(InputError, match="speed: expected numbers"):
        checked("speed", np.array([1 + 2j]), (1,))
    assert np.isnan(checked("velocity", [np.nan], (1,), "finite-or-nan")).all()
    with pytest.raises(InputError, match=r"velocity\[0\]: expected a finite number, or NaN for unknown, got -inf"):
        checked("velocity", [-np.inf], (1,), "finite-or-nan")
    assert np.isinf(checked("velocity", [-np.inf], (1,), "any")).all()


def test_messages_are_cut_and_errors_are_value_errors():
    with pytest.raises(InputError) as caught:
        checked("speed", ["fast"] * 100, (None,))
    assert len(str(caught.value)) < 120
    assert issubclass(InputError, ValueError)
    assert issubclass(InputError, SagaError)


@given(st.lists(st.text(min_size=1, alphabet=st.characters(exclude_characters="\0", exclude_categories=["Cs"]))))
def test_labels_are_kept(labels):
    result = checked_labels("label", labels, len(labels))
    assert result.tolist() == labels
    assert not result.flags.writeable


def test_wrong_labels_are_named(subtests):
    for value, length, message in [
        (["car", ""], None, r"label\[1\]: expected a name, got an empty string"),
        (["car"], 2, "label: expected 2 entries, got 1"),
        ([], 1, "label: expected 1 entries, got 0"),
        ([1, 2], None, r"label: expected a list of strings, got \[1, 2\]"),
        ("car", None, "label: expected a list of strings, got 'car'"),
        (None, None, "label: expected a list of strings, got None"),
        (["car", None], None, "label: expected a list of strings"),
        ([["car"]], None, "label: expected a list of strings"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            checked_labels("label", value, length)


@given(st.lists(st.integers(-(2**63), 2**63 - 1), unique=True))
def test_ids_are_kept(ids):
    result = checked_ids("nodes", ids, len(ids))
    assert result.tolist() == ids
    assert not result.flags.writeable


def test_wrong_ids_are_named(subtests):
    for value, length, message in [
        ([3, 1, 3], None, "nodes: expected unique ids, 3 occurs more than once"),
        ([1.0], None, r"nodes: expected a list of integers, got \[1.0\]"),
        ([True], None, "nodes: expected a list of integers"),
        (["1"], None, "nodes: expected a list of integers"),
        (1, None, "nodes: expected a list of integers, got 1"),
        ([[1]], None, "nodes: expected a list of integers"),
        ([1], 2, "nodes: expected 2 entries, got 1"),
        ([2**63], None, "nodes: expected a list of integers"),
        ([10**400], None, "nodes: expected a list of integers"),
        ([[1], [1, 2]], None, "nodes: expected a list of integers"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            checked_ids("nodes", value, length)


@given(st.integers(0, 2**32 - 1), st.integers(0, 4), st.integers(1, 5))
def test_covariances_are_accepted_and_made_exactly_symmetric(seed, count, dim):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(count, dim, dim)) * 10.0 ** rng.uniform(-6, 6, (count, dim, 1))
    P = A @ np.swapaxes(A, 1, 2) + np.einsum("kii->ki", A @ np.swapaxes(A, 1, 2))[:, :, None] * 1e-3 * np.eye(dim)
    off = P * (1 + 1e-13 * rng.normal(size=P.shape))
    result = checked_covariances("R", off, count, dim)
    assert np.array_equal(result, np.swapaxes(result, 1, 2))
    assert np.allclose(result, P, rtol=1e-11, atol=0)
    assert not result.flags.writeable


def test_neither_rounding_nor_units_spoil_a_covariance():
    turned = np.array([[1.0, 1e-17], [-1e-17, 1.0]])
    assert checked_covariances("R", [turned], 1, 2)[0].tolist() == np.eye(2).tolist()
    assert checked_covariances("R", [np.diag([1e-12, 1e12])], 1, 2).shape == (1, 2, 2)


def test_what_is_no_covariance_is_named(subtests):
    for bad, message in [
        (np.diag([1.0, 0.0]), r"R\[1\]: expected a positive definite matrix, got \[\[1.0, 0.0\], \[0.0, 0.0\]\]"),
        (np.zeros((2, 2)), r"R\[1\]: expected a positive definite matrix"),
        (np.diag([1.0, -1.0]), r"R\[1\]: expected a positive definite matrix"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), r"R\[1\]: expected a positive definite matrix"),
        (np.outer([0.1, 0.7], [0.1, 0.7]), r"R\[1\]: expected a positive definite matrix"),
        (np.array([[1.0, 0.5], [0.4, 1.0]]), r"R\[1\]: expected a symmetric matrix"),
        (np.array([[1.0, np.nan], [np.nan, 1.0]]), r"R\[1, 0, 1\]: expected a finite number"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            checked_covariances("R", [np.eye(2), bad], 2, 2)

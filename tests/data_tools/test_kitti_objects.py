from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from data_tools.kitti_objects import CameraBoxes, camera_boxes_to_world, world_boxes_to_camera
from saga_fg import InputError
from saga_fg.numerics.geometry import yaw_transform

LEVEL = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=float)  # looks along world x


def boxes(rotation_y: float = 0.0) -> CameraBoxes:
    return CameraBoxes(np.array([[1.5, 1.6, 4.0]]), np.array([[2.0, 1.75, 10.0]]), np.array([rotation_y]))


def tilted(yaw: float, pitch: float, roll: float, translation: tuple[float, float, float]) -> np.ndarray:
    def turn(angle: float, i: int, j: int) -> np.ndarray:
        R = np.eye(4)
        R[i, i] = R[j, j] = np.cos(angle)
        R[j, i], R[i, j] = np.sin(angle), -np.sin(angle)
        return R

    T = turn(yaw, 0, 1) @ turn(pitch, 2, 0) @ turn(roll, 1, 2) @ LEVEL
    T[:3, 3] = translation
    return T


def test_position_is_the_centre_and_size_is_length_width_height() -> None:
    world = camera_boxes_to_world(boxes(), ["car"], LEVEL)
    np.testing.assert_allclose(world.position, [[10, -2, -1]])  # 1.75 below the camera, plus half the height
    np.testing.assert_allclose(world.size, [[4, 1.6, 1.5]])
    assert np.isnan(world.velocity).all()


def test_yaw_of_a_level_camera(subtests: pytest.Subtests) -> None:
    for rotation_y, yaw in [(0.0, -np.pi / 2), (-np.pi / 2, 0.0), (np.pi / 2, -np.pi), (-np.pi / 4, -np.pi / 4)]:
        with subtests.test(rotation_y=rotation_y, yaw=yaw):
            # rotation_y 0 heads to the right of the camera, -90 degrees straight ahead
            world = camera_boxes_to_world(boxes(rotation_y), ["car"], yaw_transform(yaw=0.0) @ LEVEL)
            assert np.cos(world.yaw[0] - yaw) == pytest.approx(1)


angle = st.floats(-0.2, 0.2)
metres = st.floats(-1000, 1000)


@given(st.integers(0, 2**32 - 1), st.floats(-np.pi, np.pi), angle, angle, st.tuples(metres, metres, metres))
def test_there_and_back_is_exact(
    seed: int, yaw: float, pitch: float, roll: float, translation: tuple[float, float, float]
) -> None:
    rng = np.random.default_rng(seed)
    there = CameraBoxes(rng.uniform(0.3, 12, (6, 3)), rng.uniform(-80, 80, (6, 3)), rng.uniform(-np.pi, np.pi, 6))
    T = tilted(yaw, pitch, roll, translation)
    back = world_boxes_to_camera(camera_boxes_to_world(there, ["car"] * 6, T), T)
    np.testing.assert_allclose(back.size, there.size, rtol=0, atol=1e-12)
    np.testing.assert_allclose(back.location, there.location, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * back.rotation_y), np.exp(1j * there.rotation_y), rtol=0, atol=1e-9)


def test_a_pose_for_every_box() -> None:
    poses = np.stack([LEVEL, yaw_transform(5.0, 0.0, 0.0, np.pi / 2) @ LEVEL])
    two = CameraBoxes(*(np.concatenate([a, a]) for a in (boxes().size, boxes().location, boxes().rotation_y)))
    world = camera_boxes_to_world(two, ["car", "car"], poses)
    np.testing.assert_allclose(world.position, [[10, -2, -1], [7, 10, -1]], atol=1e-12)
    np.testing.assert_allclose(world_boxes_to_camera(world, poses).location, two.location)


def test_no_boxes() -> None:
    none = CameraBoxes(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    assert len(world_boxes_to_camera(camera_boxes_to_world(none, [], LEVEL), LEVEL)) == 0


def test_box_without_size_is_an_error() -> None:
    flat = CameraBoxes(np.array([[1.5, 0, 4.0]]), np.zeros((1, 3)), np.zeros(1))
    with pytest.raises(InputError, match=r"size\[0\]: expected positive"):
        camera_boxes_to_world(flat, ["car"], LEVEL)


def test_corners_stand_on_the_location() -> None:
    corners = boxes(-np.pi / 2).corners()[0]
    np.testing.assert_allclose(corners.mean(axis=0), [2, 1, 10])
    np.testing.assert_allclose(corners.min(axis=0), [1.2, 0.25, 8])
    np.testing.assert_allclose(corners.max(axis=0), [2.8, 1.75, 12])
    np.testing.assert_allclose(corners[:4, 1], 1.75)

from __future__ import annotations

import numpy as np
import pytest

from data_tools.datasets.kitti import image_boxes, observation_angles
from data_tools.kitti_objects import CameraBoxes

P2 = np.array([[700.0, 0, 600, 0], [0, 700, 180, 0], [0, 0, 1, 0]])
IMAGE = (1242, 375)


def box(x: float, y: float, z: float, rotation_y: float = 0.0, size: tuple[float, float, float] = (2, 2, 2)):
    return CameraBoxes(np.array([size], dtype=float), np.array([[x, y, z]]), np.array([rotation_y]))


def test_projection_of_a_cube_straight_ahead() -> None:
    # front face at z = 9, from -1 to 1 in x, from 0 to -2 above the ground in y
    np.testing.assert_allclose(
        image_boxes(box(0, 1, 10), P2, IMAGE), [[600 - 700 / 9, 180 - 700 / 9, 600 + 700 / 9, 180 + 700 / 9]]
    )


def test_box_is_clipped_to_the_image() -> None:
    left, top, right, bottom = image_boxes(box(-10, 1, 10), P2, IMAGE)[0]
    assert left == 0
    assert right == pytest.approx(600 - 700 * 9 / 11)
    assert image_boxes(box(0, 1.5, 3), P2, IMAGE)[0, 3] == 374
    assert 0 < top < bottom < 374


def test_box_that_does_not_show(subtests: pytest.Subtests) -> None:
    for place in [(0, 1, -10), (-30, 1, 10), (30, 1, 10), (0, 40, 10), (0, -40, 10), (0, 1, -0.95)]:
        with subtests.test(place=place):
            assert np.isnan(image_boxes(box(*place), P2, IMAGE)).all()


def test_box_beside_the_camera_reaches_to_the_edge() -> None:
    # a long box on the right, from 6 m behind to 6 m ahead of the camera: only its part ahead shows
    left, _, right, bottom = image_boxes(box(3, 1.5, 0, -np.pi / 2, (2, 2, 12)), P2, IMAGE)[0]
    assert left == pytest.approx(600 + 700 * 2 / 6)
    assert (right, bottom) == (1241, 374)


def test_no_boxes() -> None:
    none = CameraBoxes(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    assert image_boxes(none, P2, IMAGE).shape == (0, 4)


def test_observation_angle_is_seen_from_the_camera() -> None:
    assert observation_angles(box(0, 1, 10, 0.3))[0] == pytest.approx(0.3)
    assert observation_angles(box(10, 1, 10, 0.3))[0] == pytest.approx(0.3 - np.pi / 4)
    assert observation_angles(box(10, 1, 10, -3.0))[0] == pytest.approx(-3.0 - np.pi / 4 + 2 * np.pi)

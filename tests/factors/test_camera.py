"""Bearings of what a camera sees: values, Jacobians, from pixels, and what has no image."""

import gtsam
import numpy as np
import pytest

from factors import Camera, FactorError, PixelBearing, Vector, detection_factor, detection_factors
from factors.manifolds import central_differences

FORWARD = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1.0]])  # along x, 1.5 m above the ground


def camera(yaw=0.0):
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    return Camera(1000.0, 900.0, 800.0, 450.0, turn @ FORWARD)


def projected(model, x):
    """Pixels (2,) by the pinhole model."""
    c = np.linalg.inv(model.camera.world_T_camera) @ [x[0], x[1], model.height if len(x) < 3 else x[2], 1.0]
    return np.array([1000.0 * c[0] / c[2] + 800.0, 900.0 * c[1] / c[2] + 450.0])


@pytest.mark.parametrize("yaw", [0.0, 2.0, -3.0])
def test_bearings_of_pixels_are_those_of_the_position(yaw):
    rng = np.random.default_rng(0)
    model = PixelBearing(3, camera(yaw), (0, 1, 2), elevation=True)
    ahead = camera(yaw).world_T_camera[:3, 2]
    states = 15 * ahead + rng.normal(0, 3, (20, 3))
    pixels = np.array([projected(model, x) for x in states])
    z, R = model.camera.bearings(pixels, np.diag([4.0, 9.0]))
    np.testing.assert_allclose(z, model.predict(states), atol=1e-12)
    columns, spread = model.camera.bearings(pixels[:, :1], [[4.0]])
    np.testing.assert_allclose(columns, z[:, :1], atol=1e-15)
    np.testing.assert_allclose(spread, R[:, :1, :1])
    (J,) = central_differences(lambda p: model.camera.bearings(p[None], np.eye(2))[0][0], [pixels[3]], [Vector(2)])
    np.testing.assert_allclose(R[3], J @ np.diag([4.0, 9.0]) @ J.T, rtol=1e-5)


@pytest.mark.parametrize("elevation", [False, True])
@pytest.mark.parametrize("position", [(0, 2), (3, 0, 4)])
def test_jacobians_are_the_derivatives(elevation, position):
    model = PixelBearing(5, camera(0.4), position, height=0.8, elevation=elevation)
    x = np.random.default_rng(1).normal(size=(4, 5))
    x[:, list(position[:2])] += 20 * np.array([np.cos(0.4), np.sin(0.4)])
    for k in range(4):
        (J,) = central_differences(model.predict, [x[k]], [Vector(5)])
        np.testing.assert_allclose(model.jacobian(x)[k], J, atol=1e-8)
    assert model.predict(x).shape == (4, 1 + elevation)


def test_what_is_behind_the_camera_is_refused():
    model = PixelBearing(4, camera())
    factor = detection_factors([1, 2], model, [[0.1], [0.2]], [[0.01]])
    with pytest.raises(FactorError, match="behind the camera, 3 m"):
        factor.residual(np.array([[5.0, 1.0, 0, 0], [-3.0, 1.0, 0, 0]]))
    with pytest.raises(FactorError, match="behind the camera"):
        model.jacobian(np.zeros(4))


def test_residuals_wrap():
    """An azimuth is an angle, whatever whole turns a detector counts."""
    factor, values = detection_factor(1, PixelBearing(2, camera()), [2 * np.pi + 0.1], [[0.01]]), gtsam.Values()
    values.insert(1, np.array([10.0, 0.0]))
    assert factor.error(values) == pytest.approx(0.5 * 0.1**2 / 0.01)


def test_bad_input_is_refused(subtests):
    for make, message in [
        (lambda: Camera(0.0, 1.0, 0.0, 0.0), "focal lengths"),
        (lambda: Camera(1.0, 1.0, 0.0, np.nan), "intrinsics"),
        (lambda: Camera(1.0, 1.0, 0.0, 0.0, 2 * np.eye(4)), "rotation"),
        (lambda: PixelBearing(4, camera(), (0, 1, 2, 3)), "two or three"),
        (lambda: PixelBearing(4, camera(), (0, 7)), "distinct components"),
        (lambda: camera().bearings([[1.0, 2.0, 3.0]], np.eye(3)), r"shape \(n, 1\) or \(n, 2\)"),
        (lambda: camera().bearings([[np.nan]], [[1.0]]), "pixels"),
    ]:
        with subtests.test(message), pytest.raises(FactorError, match=message):
            make()

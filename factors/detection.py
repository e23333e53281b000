"""Detections: measurements of single nodes, in the world or as bearings from a camera.

    z = h(x) + v,    v ~ N(0, R)            phi  =  rho( || z - h(x) ||_R )

h is a measurement model (see `factors.measurement`); it names the components of the state it reads, so that any state
can be measured. Linear models, h(x) = H x, give native linear factors; all give nonlinear ones, robust if wished.

A linear model with an angle among its measurements is linear up to whole turns. Its linear factor needs a state nearby,
`near`: the measurement is turned until it lies within pi of what is expected there.

A detection in a camera image as bearings of the object's centre: of its pixel column, and of its row if wished.

With the centre c = R^T (p - t) = (X, Y, Z) in the camera's frame, x to the right, y down, z along the optical axis, and
world_T_camera = (R, t),

    azimuth    = atan2(X, Z)              = atan((u - cx) / fx)                                 u: pixel column
    elevation  = atan2(Y, hypot(X, Z))    = atan((v - cy) / fy / hypot(1, (u - cx) / fx))       v: pixel row

    d azimuth / dc = (Z, 0, -X) / rho^2,    d elevation / dc = (-X Y / rho, rho, -Y Z / rho) / (rho^2 + Y^2)

with rho = hypot(X, Z). Source of the pinhole model: Hartley and Zisserman, Multiple View Geometry (2004), section 6.1.
An object behind the camera has no image: that is an error, and no bearing beyond 90 degrees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors.gaussian import gaussian_factor, gaussian_factors
from factors.manifolds import Vector, wrap_angles
from factors.measurement import MeasurementModel, checked_components
from factors.nonlinear import ResidualFactor, ResidualFactors
from factors.robust import RobustLoss
from factors.validation import FactorError, FloatArray, KeyArray, checked, checked_covariances, checked_key_array


def detection_factor(
    key: int, model: MeasurementModel, z: ArrayLike, R: ArrayLike, robust: RobustLoss | None = None
) -> ResidualFactor:
    """Return the factor rho(|| h(x) - z ||_R) on the vector variable `key`.

    z: (m,) measured; R: (m, m), positive definite. Raises `FactorError`, now or when linearised where h is undefined.
    """
    measured = checked("z", z, (model.dim,)).copy()
    function = _Detection(model, measured)
    return ResidualFactor(
        keys=(key,),
        variables=(Vector(model.state_dim),),
        residual=function.residual,
        covariance=checked("R", R, (model.dim, model.dim)),
        jacobians=function.jacobians,
        robust=robust,
        angles=tuple(model.angles),
        name=f"{model.name} detection",
    )


def detection_factors(
    keys: ArrayLike, model: MeasurementModel, z: ArrayLike, R: ArrayLike, robust: RobustLoss | None = None
) -> ResidualFactors:
    """Return n factors of one model, linearised together; keys: (n,), z: (n, m), R: (n, m, m), or (m, m) for all."""
    measured = checked("z", z, (None, model.dim)).copy()
    function = _Detection(model, measured)
    return ResidualFactors(
        rows=_column(keys, len(measured)),
        dims=(model.state_dim,),
        residual=function.residual,
        covariances=checked_covariances("R", R, len(measured), model.dim),
        jacobians=function.jacobians,
        robust=robust,
        angles=tuple(model.angles),
        name=f"{model.name} detections",
    )


def linear_detection_factor(
    key: int, model: MeasurementModel, z: ArrayLike, R: ArrayLike, near: ArrayLike | None = None
) -> gtsam.JacobianFactor:
    """Return the native factor || H x - z ||_R of a linear model.

    near: a state (d,) close by, needed by models that measure an angle. Raises `FactorError` for a nonlinear model.
    """
    measured = checked("z", z, (model.dim,))
    H = linear_matrix(model)
    reference = None if near is None else checked("near", near, (model.state_dim,))
    return gaussian_factor([key], [H], _unwrapped(model, H, measured, reference), R)


def linear_detection_factors(
    keys: ArrayLike, model: MeasurementModel, z: ArrayLike, R: ArrayLike, near: ArrayLike | None = None
) -> list[gtsam.JacobianFactor]:
    """Return n native factors of one linear model; keys: (n,), z: (n, m), R: (n, m, m) or (m, m), near: (n, d)."""
    measured = checked("z", z, (None, model.dim))
    H = linear_matrix(model)
    reference = None if near is None else checked("near", near, (len(measured), model.state_dim))
    blocks = np.broadcast_to(H, (len(measured), *H.shape))
    return gaussian_factors(
        _column(keys, len(measured)),
        [blocks],
        _unwrapped(model, H, measured, reference),
        checked_covariances("R", R, len(measured), model.dim),
    )


def linear_matrix(model: MeasurementModel) -> FloatArray:
    """Return H (m, d) of a linear model; raise `FactorError` for another."""
    if not model.linear:
        raise FactorError(f"model: expected a linear one, {model.name} is not")
    return model.jacobian(np.zeros(model.state_dim))


def _column(keys: ArrayLike, n: int) -> KeyArray:
    names = checked_key_array("keys", keys)
    if len(names) != n:
        raise FactorError(f"keys: expected {n}, one per measurement, got {len(names)}")
    return names[:, None]


def _unwrapped(model: MeasurementModel, H: FloatArray, z: FloatArray, near: FloatArray | None) -> FloatArray:
    if not model.angles:
        return z
    if near is None:
        raise FactorError(f"near: expected a state, because {model.name} measures an angle")
    expected = near @ H.T
    turned = wrap_angles(z - expected, model.angles)
    index = list(model.angles)
    result = z.copy()
    result[..., index] = expected[..., index] + turned[..., index]
    return result


@dataclass(frozen=True)
class _Detection:
    model: MeasurementModel
    z: FloatArray

    def residual(self, x: FloatArray) -> FloatArray:
        return self.model.predict(x) - self.z

    def jacobians(self, x: FloatArray) -> Sequence[FloatArray]:
        return [self.model.jacobian(x)]


@dataclass(frozen=True, eq=False)
class Camera:
    """fx, fy, cx, cy: focal lengths and principal point, pixels; world_T_camera: (4, 4). Raises `FactorError`."""

    fx: float
    fy: float
    cx: float
    cy: float
    world_T_camera: FloatArray = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        pose = checked("world_T_camera", self.world_T_camera, (4, 4)).copy()
        if not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6) or np.linalg.det(pose[:3, :3]) < 0:
            raise FactorError("world_T_camera: expected a rotation in the upper left")
        checked("intrinsics", [self.fx, self.fy, self.cx, self.cy], (4,))
        if not (self.fx > 0 and self.fy > 0):
            raise FactorError(f"fx, fy: expected positive focal lengths, got {self.fx} and {self.fy}")
        object.__setattr__(self, "world_T_camera", pose)

    def bearings(self, pixels: ArrayLike, covariances: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return bearings (n, k), rad, and their covariances (n, k, k), of pixels (n, k): columns, or columns and rows.

        covariances: (n, k, k), or one (k, k) for all, pixels^2. Raises `FactorError`.
        """
        measured = np.array(pixels, dtype=np.float64)
        if measured.ndim != 2 or measured.shape[1] not in (1, 2):
            raise FactorError(f"pixels: expected shape (n, 1) or (n, 2), got {measured.shape}")
        n, k = checked("pixels", measured, measured.shape).shape
        R = checked_covariances("covariances", covariances, n, k)
        a = (measured[:, 0] - self.cx) / self.fx
        z, J = np.arctan(measured), np.zeros((n, k, k))
        z[:, 0], J[:, 0, 0] = np.arctan(a), 1 / (self.fx * (1 + a * a))
        if k == 2:
            root, b = np.hypot(1, a), (measured[:, 1] - self.cy) / self.fy
            z[:, 1] = np.arctan2(b, root)
            J[:, 1, 0] = -b * a / (root * (root**2 + b**2)) / self.fx
            J[:, 1, 1] = root / (root**2 + b**2) / self.fy
        return z, J @ R @ np.swapaxes(J, 1, 2)


@dataclass(frozen=True, eq=False)
class PixelBearing:
    """Azimuth, and elevation if wished, rad, of a position seen by a camera; see `Camera.bearings` for the measurement.

    position: where x, y (and z) sit in the state; height: of the object's centre where the state has no z, m.
    """

    state_dim: int
    camera: Camera
    position: tuple[int, ...] = (0, 1)
    height: float = 0.0
    elevation: bool = False

    def __post_init__(self) -> None:
        checked_components("position", self.position, self.state_dim, least=2)
        if len(self.position) > 3:
            raise FactorError(f"position: expected two or three components, got {self.position}")

    @property
    def name(self) -> str:
        return "pixel bearing"

    @property
    def dim(self) -> int:
        return 1 + self.elevation

    @property
    def angles(self) -> tuple[int, ...]:
        return tuple(range(self.dim))

    @property
    def linear(self) -> bool:
        return False

    def predict(self, x: FloatArray) -> FloatArray:
        X, Y, Z = np.moveaxis(self._centre(x), -1, 0)
        return np.stack([np.arctan2(X, Z), np.arctan2(Y, np.hypot(X, Z))][: self.dim], axis=-1)

    def jacobian(self, x: FloatArray) -> FloatArray:
        X, Y, Z = np.moveaxis(self._centre(x), -1, 0)
        rho = np.hypot(X, Z)
        azimuth = np.stack([Z, 0 * X, -X], axis=-1) / (rho**2)[..., None]
        elevation = np.stack([-X * Y / rho, rho, -Y * Z / rho], axis=-1) / (rho**2 + Y**2)[..., None]
        by_centre = np.stack([azimuth, elevation][: self.dim], axis=-2)
        J = np.zeros((*x.shape[:-1], self.dim, self.state_dim))
        J[..., list(self.position)] = by_centre @ self.camera.world_T_camera[: len(self.position), :3].T
        return J

    def _centre(self, x: FloatArray) -> FloatArray:
        """(..., 3) in the camera's frame."""
        p = np.full((*x.shape[:-1], 3), self.height)
        p[..., : len(self.position)] = x[..., list(self.position)]
        pose = self.camera.world_T_camera
        centre: FloatArray = (p - pose[:3, 3]) @ pose[:3, :3]
        if not np.all(centre[..., 2] > 0):
            raise FactorError(f"an object is behind the camera, {-centre[..., 2].min():.3g} m, where it has no image")
        return centre

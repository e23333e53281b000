"""A detection in a camera image as bearings of the object's centre: of its pixel column, and of its row if wished.

With the centre c = R^T (p - t) = (X, Y, Z) in the camera's frame, x to the right, y down, z along the optical axis, and
world_T_camera = (R, t),

    azimuth    = atan2(X, Z)              = atan((u - cx) / fx)                                 u: pixel column
    elevation  = atan2(Y, hypot(X, Z))    = atan((v - cy) / fy / hypot(1, (u - cx) / fx))       v: pixel row

    d azimuth / dc = (Z, 0, -X) / rho^2,    d elevation / dc = (-X Y / rho, rho, -Y Z / rho) / (rho^2 + Y^2)

with rho = hypot(X, Z). Source of the pinhole model: Hartley and Zisserman, Multiple View Geometry (2004), section 6.1.
An object behind the camera has no image: that is an error, and no bearing beyond 90 degrees.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from factors.errors import FactorError
from factors.measurement import checked_components
from factors.validation import FloatArray, checked, checked_covariances


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

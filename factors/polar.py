"""Polar measurement models: what a radar, sonar or laser range finder sees in the plane.

The sensor stands at s = (s_x, s_y) with heading phi and moves with velocity u; all are given in the frame of the state
(world_T_sensor). With d = p - s, rho = |d| and the position p and velocity v of the state:

    range and bearing    z = (rho, atan2(d_y, d_x) - phi)
    range rate           z = d . (v - u) / rho                     positive when the object recedes
    radar                z = (rho, bearing, range rate)

    d rho / dp  = d / rho                               d bearing / dp = (-d_y, d_x) / rho^2
    d rate / dp = ((v - u) - rate d / rho) / rho        d rate / dv    = d / rho

All are undefined where the object is at the sensor itself. Source: Bar-Shalom, Li and Kirubarajan, Estimation with
Applications to Tracking and Navigation (2001), section 10.4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factors.errors import FactorError
from factors.measurement import checked_components
from factors.validation import FloatArray, checked


@dataclass(frozen=True)
class RangeBearing:
    """Range (m) and bearing (rad, from the sensor's heading, counterclockwise) of a position.

    position: where x and y sit in the state; sensor_pose: (x m, y m, heading rad).
    """

    state_dim: int
    position: tuple[int, int] = (0, 1)
    sensor_pose: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        _check(self.state_dim, self.position, (), self.sensor_pose)

    @property
    def name(self) -> str:
        return "range and bearing"

    @property
    def dim(self) -> int:
        return 2

    @property
    def angles(self) -> tuple[int, ...]:
        return (1,)

    @property
    def linear(self) -> bool:
        return False

    def predict(self, x: FloatArray) -> FloatArray:
        d, rho = _offset(x, self.position, self.sensor_pose)
        return np.stack([rho, np.arctan2(d[..., 1], d[..., 0]) - self.sensor_pose[2]], axis=-1)

    def jacobian(self, x: FloatArray) -> FloatArray:
        d, rho = _offset(x, self.position, self.sensor_pose)
        J = np.zeros((*x.shape[:-1], 2, self.state_dim))
        J[..., 0, list(self.position)] = d / rho[..., None]
        J[..., 1, list(self.position)] = np.stack([-d[..., 1], d[..., 0]], axis=-1) / rho[..., None] ** 2
        return J


@dataclass(frozen=True)
class RangeRate:
    """Range rate (m/s) of a moving position, seen from a sensor that may move itself.

    position, velocity: where they sit in the state; sensor_pose: (x m, y m, heading rad); sensor_velocity: (m/s, m/s).
    """

    state_dim: int
    position: tuple[int, int] = (0, 1)
    velocity: tuple[int, int] = (2, 3)
    sensor_pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sensor_velocity: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        _check(self.state_dim, self.position, self.velocity, self.sensor_pose)
        checked("sensor_velocity", self.sensor_velocity, (2,))

    @property
    def name(self) -> str:
        return "range rate"

    @property
    def dim(self) -> int:
        return 1

    @property
    def angles(self) -> tuple[int, ...]:
        return ()

    @property
    def linear(self) -> bool:
        return False

    def predict(self, x: FloatArray) -> FloatArray:
        _, _, rate, _ = self._parts(x)
        return rate[..., None]

    def jacobian(self, x: FloatArray) -> FloatArray:
        towards, rho, rate, relative = self._parts(x)
        J = np.zeros((*x.shape[:-1], 1, self.state_dim))
        J[..., 0, list(self.position)] = (relative - rate[..., None] * towards) / rho[..., None]
        J[..., 0, list(self.velocity)] = towards
        return J

    def _parts(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        d, rho = _offset(x, self.position, self.sensor_pose)
        towards = d / rho[..., None]
        relative = x[..., list(self.velocity)] - np.asarray(self.sensor_velocity)
        return towards, rho, (towards * relative).sum(axis=-1), relative


@dataclass(frozen=True)
class Radar:
    """Range (m), bearing (rad) and range rate (m/s) together; fields as in `RangeRate`."""

    state_dim: int
    position: tuple[int, int] = (0, 1)
    velocity: tuple[int, int] = (2, 3)
    sensor_pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sensor_velocity: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        self._rate()  # checks the fields

    @property
    def name(self) -> str:
        return "radar"

    @property
    def dim(self) -> int:
        return 3

    @property
    def angles(self) -> tuple[int, ...]:
        return (1,)

    @property
    def linear(self) -> bool:
        return False

    def predict(self, x: FloatArray) -> FloatArray:
        return np.concatenate([self._bearing().predict(x), self._rate().predict(x)], axis=-1)

    def jacobian(self, x: FloatArray) -> FloatArray:
        return np.concatenate([self._bearing().jacobian(x), self._rate().jacobian(x)], axis=-2)

    def _bearing(self) -> RangeBearing:
        return RangeBearing(self.state_dim, self.position, self.sensor_pose)

    def _rate(self) -> RangeRate:
        return RangeRate(self.state_dim, self.position, self.velocity, self.sensor_pose, self.sensor_velocity)


def _offset(
    x: FloatArray, position: tuple[int, int], sensor_pose: tuple[float, float, float]
) -> tuple[FloatArray, FloatArray]:
    d = x[..., list(position)] - np.asarray(sensor_pose[:2])
    rho = np.hypot(d[..., 0], d[..., 1])
    if not (rho > 0).all():
        raise FactorError("the object is at the sensor itself, where range and bearing have no derivative")
    return d, rho


def _check(
    state_dim: int, position: tuple[int, ...], velocity: tuple[int, ...], sensor_pose: tuple[float, ...]
) -> None:
    checked_components("position", position, state_dim)
    checked_components("position and velocity", (*position, *velocity), state_dim)
    if len(position) != 2 or len(velocity) not in (0, 2):
        raise FactorError(f"expected two components each of position and velocity, got {position} and {velocity}")
    checked("sensor_pose", sensor_pose, (3,))

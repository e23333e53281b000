"""Polar measurement models: what a radar, sonar or laser range finder sees in the plane.

The sensor stands at s = (s_x, s_y) with heading phi and moves with velocity u; all are given in the frame of the state
(world_T_sensor). With d = p - s, rho = |d| and the position p and velocity v of the state:

    range and bearing    z = (rho, atan2(d_y, d_x) - phi)       or one of them alone
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
from factors.measurement import Part, checked_components
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
        z = np.empty((*x.shape[:-1], 2))
        z[..., 0], z[..., 1] = _range_bearing(_sight(x, self.position, self.sensor_pose), self.sensor_pose)
        return z

    def jacobian(self, x: FloatArray) -> FloatArray:
        J = np.zeros((*x.shape[:-1], 2, self.state_dim))
        _range_bearing_jacobian(J, _sight(x, self.position, self.sensor_pose), self.position)
        return J


def range_only(
    state_dim: int, position: tuple[int, int] = (0, 1), sensor_pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Part:
    """Return the model of a measured range (m); fields as in `RangeBearing`."""
    return Part(RangeBearing(state_dim, position, sensor_pose), (0,), "range")


def bearing_only(
    state_dim: int, position: tuple[int, int] = (0, 1), sensor_pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Part:
    """Return the model of a measured bearing (rad); fields as in `RangeBearing`."""
    return Part(RangeBearing(state_dim, position, sensor_pose), (1,), "bearing")


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
        sight = _sight(x, self.position, self.sensor_pose)
        return _rate(sight, _relative(x, self.velocity, self.sensor_velocity))[..., None]

    def jacobian(self, x: FloatArray) -> FloatArray:
        J = np.zeros((*x.shape[:-1], 1, self.state_dim))
        sight = _sight(x, self.position, self.sensor_pose)
        relative = _relative(x, self.velocity, self.sensor_velocity)
        _rate_jacobian(J[..., 0, :], sight, relative, self.position, self.velocity)
        return J


@dataclass(frozen=True)
class Radar:
    """Range (m), bearing (rad) and range rate (m/s) together; fields as in `RangeRate`."""

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
        sight = _sight(x, self.position, self.sensor_pose)
        z = np.empty((*x.shape[:-1], 3))
        z[..., 0], z[..., 1] = _range_bearing(sight, self.sensor_pose)
        z[..., 2] = _rate(sight, _relative(x, self.velocity, self.sensor_velocity))
        return z

    def jacobian(self, x: FloatArray) -> FloatArray:
        sight = _sight(x, self.position, self.sensor_pose)
        J = np.zeros((*x.shape[:-1], 3, self.state_dim))
        _range_bearing_jacobian(J, sight, self.position)
        relative = _relative(x, self.velocity, self.sensor_velocity)
        _rate_jacobian(J[..., 2, :], sight, relative, self.position, self.velocity)
        return J


@dataclass(frozen=True)
class _Sight:
    """Line of sight: unit vector (c, s) from sensor to object and the range; each (...,)."""

    c: FloatArray
    s: FloatArray
    range: FloatArray


def _sight(x: FloatArray, position: tuple[int, int], sensor_pose: tuple[float, float, float]) -> _Sight:
    dx, dy = x[..., position[0]] - sensor_pose[0], x[..., position[1]] - sensor_pose[1]
    rho = np.hypot(dx, dy)
    if not np.all(rho > 0):
        raise FactorError("the object is at the sensor itself, where range and bearing have no derivative")
    return _Sight(dx / rho, dy / rho, rho)


def _relative(
    x: FloatArray, velocity: tuple[int, int], sensor_velocity: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    return x[..., velocity[0]] - sensor_velocity[0], x[..., velocity[1]] - sensor_velocity[1]


def _range_bearing(sight: _Sight, sensor_pose: tuple[float, float, float]) -> tuple[FloatArray, FloatArray]:
    return sight.range, np.arctan2(sight.s, sight.c) - sensor_pose[2]


def _range_bearing_jacobian(J: FloatArray, sight: _Sight, position: tuple[int, int]) -> None:
    """Fill the first two rows of J (..., m, d)."""
    J[..., 0, position[0]], J[..., 0, position[1]] = sight.c, sight.s
    J[..., 1, position[0]], J[..., 1, position[1]] = -sight.s / sight.range, sight.c / sight.range


def _rate(sight: _Sight, relative: tuple[FloatArray, FloatArray]) -> FloatArray:
    return sight.c * relative[0] + sight.s * relative[1]


def _rate_jacobian(
    row: FloatArray,
    sight: _Sight,
    relative: tuple[FloatArray, FloatArray],
    position: tuple[int, int],
    velocity: tuple[int, int],
) -> None:
    """Fill a row (..., d) of the Jacobian."""
    rate = _rate(sight, relative)
    row[..., position[0]] = (relative[0] - rate * sight.c) / sight.range
    row[..., position[1]] = (relative[1] - rate * sight.s) / sight.range
    row[..., velocity[0]], row[..., velocity[1]] = sight.c, sight.s


def _check(
    state_dim: int, position: tuple[int, ...], velocity: tuple[int, ...], sensor_pose: tuple[float, ...]
) -> None:
    checked_components("position", position, state_dim)
    checked_components("position and velocity", (*position, *velocity), state_dim)
    if len(position) != 2 or len(velocity) not in (0, 2):
        raise FactorError(f"expected two components each of position and velocity, got {position} and {velocity}")
    checked("sensor_pose", sensor_pose, (3,))

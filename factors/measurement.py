"""Measurement models h(x) on vector states, and detections: measurements of single nodes.

    z = h(x) + v,    v ~ N(0, R)            phi  =  rho( || z - h(x) ||_R )

Polar measurement models: what a radar, sonar or laser range finder sees in the plane.

The sensor stands at s = (s_x, s_y) with heading phi and moves with velocity u; all are given in the frame of the state
(world_T_sensor). With d = p - s, rho = |d| and the position p and velocity v of the state:

    range         rho
    bearing       atan2(d_y, d_x) - phi
    range rate    d . (v - u) / rho                             positive when the object recedes

    d rho / dp  = d / rho                               d bearing / dp = (-d_y, d_x) / rho^2
    d rate / dp = ((v - u) - rate d / rho) / rho        d rate / dv    = d / rho

Nearer than 1 cm, finer than any sensor measures, range and rate have the soft distance in place of rho,
so that they and their derivatives are continuous for an object that passes through the sensor. A bearing cannot be:
round the sensor it takes all values, however near. There it is undefined. Source: Bar-Shalom, Li and
Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), section 10.4.

Distances in the plane that are smooth at zero, where |d| has a tip and d / |d| no direction.

    r(d) = |d|                                    from |d| = w on
    r(d) = w / 8 (3 + 6 x^2 - x^4),   x = |d| / w   nearer

    u = dr/dd = d / q              q = |d|,   nearer 2 w / (3 - x^2)
    du/dd = (I - k u u^T) / q      k = 1,     nearer (q / w)^3

r is the even polynomial of degree 4 that meets |d| with two derivatives, so that u and du/dd are continuous: |u| <= 1,
u = 0 at d = 0, and du/dd is at most 3 / (2 w), its change at most 3 / w^2 per metre. Nothing changes from w on. Forces
between bodies of N-body simulations are softened within a radius in this way (Hernquist and Katz, Astrophysical Journal
Supplement 70, 1989, appendix A).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from factors.nonlinear import ResidualFactors, residual_factors
from factors.robust import RobustLoss
from factors.validation import FactorError, FloatArray, checked, checked_key_array


class MeasurementModel(Protocol):
    """h, its Jacobian, and what the numbers are. Both functions take one state or many at once."""

    @property
    def name(self) -> str:
        """Name of the measured quantity, for messages."""

    @property
    def state_dim(self) -> int:
        """Dimension d of the state."""

    @property
    def dim(self) -> int:
        """Dimension m of the measurement."""

    @property
    def angles(self) -> Sequence[int]:
        """Components of the measurement that are angles in rad."""

    def predict(self, x: FloatArray) -> FloatArray:
        """Return h (..., m) at states (..., d)."""

    def jacobian(self, x: FloatArray) -> FloatArray:
        """Return dh/dx (..., m, d) at states (..., d)."""


def checked_components(name: str, components: Sequence[int], dim: int, least: int = 1) -> None:
    """Raise `FactorError` unless `components` are at least `least` distinct indices below `dim`."""
    indices = list(components)
    valid = all(isinstance(i, int | np.integer) and not isinstance(i, bool) and 0 <= i < dim for i in indices)
    if not valid or len(set(indices)) != len(indices) or len(indices) < least:
        raise FactorError(f"{name}: expected distinct components from 0 to {dim - 1}, got {tuple(indices)}")


class SoftDistance(NamedTuple):
    """r (...), m; u (..., 2), its gradient; q (...), m, and k (...), from which the derivative of u is."""

    value: FloatArray
    direction: FloatArray
    radius: FloatArray
    share: FloatArray

    def bend(self) -> FloatArray:
        """The derivative (..., 2, 2) of u, 1/m."""
        u = self.direction
        along = self.share[..., None, None] * u[..., :, None] * u[..., None, :]
        return np.asarray((np.eye(2) - along) / self.radius[..., None, None])


def soft_distance(d: FloatArray, width: float) -> SoftDistance:
    """Return the soft length of vectors d (..., 2), m; width: w > 0, m."""
    length = np.hypot(d[..., 0], d[..., 1])
    near = length < width
    square = np.where(near, length / width, 1.0) ** 2
    radius = np.where(near, 2 * width / (3 - square), length)
    return SoftDistance(
        np.where(near, width / 8 * (3 + square * (6 - square)), length),
        d / radius[..., None],
        radius,
        np.where(near, (radius / width) ** 3, 1.0),
    )


Pair = tuple[int, int]
Pose = tuple[float, float, float]
RANGE, BEARING, RANGE_RATE = "range", "bearing", "range rate"
_SOFT = 0.01  # m; finer than any sensor measures


@dataclass(frozen=True)
class Polar:
    """Range (m), bearing (rad, from the sensor's heading, counterclockwise) and range rate (m/s), or some of them.

    measured: which, in order; position, velocity: where they sit in the state, velocity () if no rate is measured;
    sensor_pose: (x m, y m, heading rad); sensor_velocity: (m/s, m/s).
    """

    state_dim: int
    measured: tuple[str, ...]
    position: Pair = (0, 1)
    velocity: tuple[int, ...] = ()
    sensor_pose: Pose = (0.0, 0.0, 0.0)
    sensor_velocity: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        checked_components("position", self.position, self.state_dim)
        checked_components("position and velocity", (*self.position, *self.velocity), self.state_dim)
        if len(self.position) != 2 or len(self.velocity) != 2 * (RANGE_RATE in self.measured):
            raise FactorError(
                f"expected two components each of position and velocity, got {self.position} and {self.velocity}"
            )
        checked("sensor_pose", self.sensor_pose, (3,))
        checked("sensor_velocity", self.sensor_velocity, (2,))

    @property
    def name(self) -> str:
        return "radar" if len(self.measured) == 3 else " and ".join(self.measured)

    @property
    def dim(self) -> int:
        return len(self.measured)

    @property
    def angles(self) -> tuple[int, ...]:
        return tuple(k for k, name in enumerate(self.measured) if name == BEARING)

    def predict(self, x: FloatArray) -> FloatArray:
        d, sight = self._sight(x)
        z = {RANGE: sight.value, BEARING: np.arctan2(d[..., 1], d[..., 0]) - self.sensor_pose[2]}
        if self.velocity:
            z[RANGE_RATE] = (sight.direction * self._relative(x)).sum(axis=-1)
        return np.stack([z[name] for name in self.measured], axis=-1)

    def jacobian(self, x: FloatArray) -> FloatArray:
        d, sight = self._sight(x)
        u = sight.direction
        by_position = {RANGE: u}
        if BEARING in self.measured:
            rho = np.hypot(d[..., 0], d[..., 1])[..., None]
            by_position[BEARING] = np.stack([-d[..., 1], d[..., 0]], axis=-1) / rho / rho
        J = np.zeros((*x.shape[:-1], self.dim, self.state_dim))
        if self.velocity:
            relative = self._relative(x)
            rate = sight.share[..., None] * (u * relative).sum(axis=-1, keepdims=True)
            by_position[RANGE_RATE] = (relative - rate * u) / sight.radius[..., None]
            J[..., self.measured.index(RANGE_RATE), list(self.velocity)] = u
        for row, name in enumerate(self.measured):
            J[..., row, list(self.position)] = by_position[name]
        return J

    def _sight(self, x: FloatArray) -> tuple[FloatArray, SoftDistance]:
        """Vectors (..., 2) from sensor to object, and their lengths."""
        d = x[..., list(self.position)] - np.array(self.sensor_pose[:2])
        if BEARING in self.measured and not (d != 0).any(axis=-1).all():
            raise FactorError("the object is at the sensor itself, where a bearing has no derivative")
        return d, soft_distance(d, _SOFT)

    def _relative(self, x: FloatArray) -> FloatArray:
        return np.asarray(x[..., list(self.velocity)] - np.array(self.sensor_velocity))


def Range(state_dim: int, position: Pair = (0, 1), sensor_pose: Pose = (0.0, 0.0, 0.0)) -> Polar:
    """Return the model of a measured range; fields as in `Polar`."""
    return Polar(state_dim, (RANGE,), position, (), sensor_pose)


def Bearing(state_dim: int, position: Pair = (0, 1), sensor_pose: Pose = (0.0, 0.0, 0.0)) -> Polar:
    """Return the model of a measured bearing."""
    return Polar(state_dim, (BEARING,), position, (), sensor_pose)


def RangeBearing(state_dim: int, position: Pair = (0, 1), sensor_pose: Pose = (0.0, 0.0, 0.0)) -> Polar:
    """Return the model of a measured range and bearing."""
    return Polar(state_dim, (RANGE, BEARING), position, (), sensor_pose)


def RangeRate(
    state_dim: int,
    position: Pair = (0, 1),
    velocity: Pair = (2, 3),
    sensor_pose: Pose = (0.0, 0.0, 0.0),
    sensor_velocity: tuple[float, float] = (0.0, 0.0),
) -> Polar:
    """Return the model of a measured range rate."""
    return Polar(state_dim, (RANGE_RATE,), position, velocity, sensor_pose, sensor_velocity)


def Radar(
    state_dim: int,
    position: Pair = (0, 1),
    velocity: Pair = (2, 3),
    sensor_pose: Pose = (0.0, 0.0, 0.0),
    sensor_velocity: tuple[float, float] = (0.0, 0.0),
) -> Polar:
    """Return the model of a measured range, bearing and range rate."""
    return Polar(state_dim, (RANGE, BEARING, RANGE_RATE), position, velocity, sensor_pose, sensor_velocity)


def detection_factors(
    keys: ArrayLike, model: MeasurementModel, z: ArrayLike, R: ArrayLike, robust: RobustLoss | None = None
) -> ResidualFactors:
    """Return n factors rho(|| h(x) - z ||_R) of one model on vector variables, linearised together.

    keys: (n,); z: (n, m) measured; R: (n, m, m), or (m, m) for all, positive definite. Raises `FactorError`, now or
    when linearised where h is undefined.
    """
    rows = checked_key_array("keys", keys)[:, None]
    measured = checked("z", z, (len(rows), model.dim)).copy()
    name = f"{model.name} detections"
    return residual_factors(
        _Detection(model, measured), rows, (model.state_dim,), R, model.dim, name, robust, model.angles
    )


@dataclass(frozen=True)
class _Detection:
    model: MeasurementModel
    z: FloatArray

    def residual(self, x: FloatArray) -> FloatArray:
        return self.model.predict(x) - self.z

    def jacobians(self, x: FloatArray) -> Sequence[FloatArray]:
        return [self.model.jacobian(x)]

r"""Motion along circles: coordinated turn and kinematic bicycle.

The states have Cartesian velocities, so that what acts on positions and velocities (interactions, detections, range
rates) finds them as in every other state, and nothing is singular at speed 0, as a course would be. Position p and
velocity v turn by the angle theta within the interval dt, with J = ((0, -1), (1, 0)):

    v' = R(theta) v,   p' = p + dt S(theta) v,   c' = c,   S(theta) = sin(theta) / theta I + (1 - cos(theta)) / theta J

    coordinated turn     theta = c dt                                c: turn rate, rad/s
    kinematic bicycle    theta = |v| kappa(c) dt                     c: steering angle, rad
                         kappa = sin(beta) / l,   tan(beta) = tan(c) / 2,   l half the wheelbase

which solves dp/dt = v, dv/dt = (theta / dt) J v exactly, as the speed and c are constant. Sources: Bar-Shalom, Li and
Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), section 11.7.1; Rajamani, Vehicle Dynamics
and Control (2012), section 2.2, with the course psi + beta of the centre as the direction of v. A bicycle at rest
does not turn. S and its derivative are smooth at theta = 0, where the motion is that of constant velocity.

Noise: white acceleration and a random walk of c, discretised along the linear part dp/dt = v. It does not depend on the
state (Bar-Shalom, section 11.7.1): what the noise of c does to the velocity within the same interval is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from saga_fg.numerics.arrays import FloatArray
from saga_fg.settings import NonNegative, Positive, Settings, setting

_TINY = 1e-2  # rad; below, series
_STRAIGHT = np.diag([1.0, 1.0, 0.0], k=2)  # dp/dt = v
STEERING_NOISE = 0.02  # spectral density of the random walk of the steering angle, rad^2/s
INITIAL_STEERING_DEVIATION = 0.1  # standard deviation of the steering angle of a new object, rad
INITIAL_TURN_RATE_DEVIATION = 0.2  # standard deviation of the turn rate of a new object, rad/s


@dataclass(frozen=True)
class CoordinatedTurn(Settings):
    """A turn of nearly constant rate and speed."""

    acceleration_noise: NonNegative = setting(2.0, "spectral density of the acceleration, m^2/s^3; usual 0.3 to 3")
    turn_noise: NonNegative = setting(
        0.05, "spectral density of the random walk of the turn rate, rad^2/s^3; higher: turns are followed faster"
    )

    @property
    def components(self) -> tuple[str, ...]:
        return ("x", "y", "vx", "vy", "turn_rate")

    @property
    def generator(self) -> FloatArray:
        return _STRAIGHT

    @property
    def diffusion(self) -> FloatArray:
        return np.diag([0.0, 0.0, self.acceleration_noise, self.acceleration_noise, self.turn_noise])

    @property
    def initial_deviation(self) -> FloatArray:
        """(5,) of a new object, where nothing is measured."""
        return np.array([1.0, 1.0, 1.0, 1.0, INITIAL_TURN_RATE_DEVIATION])

    def flow(self, x: FloatArray, dt: float) -> FloatArray:
        """States (..., 5) after dt seconds; dt may be negative."""
        return _turned(x, x[..., 4] * dt, dt)

    def flow_jacobian(self, x: FloatArray, dt: float) -> FloatArray:
        """Derivative (..., 5, 5) of `flow`."""
        by_state = np.zeros_like(x)
        by_state[..., 4] = dt
        return _turned_jacobian(x, x[..., 4] * dt, by_state, dt)


@dataclass(frozen=True)
class Bicycle(Settings):
    """The kinematic bicycle: a vehicle turns as it is steered, and only while it moves; left is positive."""

    acceleration_noise: NonNegative = setting(2.0, "spectral density of the acceleration, m^2/s^3; usual 0.3 to 3")
    wheelbase: Positive = setting(
        2.8, "distance between the axles, m; usual 2.5 to 3; higher: the same steering angle turns less"
    )

    @property
    def components(self) -> tuple[str, ...]:
        return ("x", "y", "vx", "vy", "steering")

    @property
    def generator(self) -> FloatArray:
        return _STRAIGHT

    @property
    def diffusion(self) -> FloatArray:
        return np.diag([0.0, 0.0, self.acceleration_noise, self.acceleration_noise, STEERING_NOISE])

    @property
    def initial_deviation(self) -> FloatArray:
        """(5,) of a new object, where nothing is measured."""
        return np.array([1.0, 1.0, 1.0, 1.0, INITIAL_STEERING_DEVIATION])

    def flow(self, x: FloatArray, dt: float) -> FloatArray:
        """States (..., 5) after dt seconds; dt may be negative."""
        return _turned(x, dt * np.hypot(x[..., 2], x[..., 3]) * self._curvature(x[..., 4])[0], dt)

    def flow_jacobian(self, x: FloatArray, dt: float) -> FloatArray:
        """Derivative (..., 5, 5) of `flow`."""
        speed = np.hypot(x[..., 2], x[..., 3])
        curvature, by_steering = self._curvature(x[..., 4])
        by_state = np.zeros_like(x)
        by_state[..., 2:4] = (dt * curvature / np.where(speed > 0, speed, 1.0))[..., None] * x[..., 2:4]
        by_state[..., 4] = dt * speed * by_steering
        return _turned_jacobian(x, dt * speed * curvature, by_state, dt)

    def _curvature(self, steering: FloatArray) -> tuple[FloatArray, FloatArray]:
        """kappa (...), 1/m, and its derivative; sin(beta) = s / sqrt(4 c^2 + s^2), s and c of the steering angle.

        Past a right angle, where a vehicle would roll backwards, it goes on without a jump.
        """
        s, c = np.sin(steering), np.cos(steering)
        root = np.sqrt(4 * c * c + s * s)
        half = self.wheelbase / 2
        return s / (root * half), 4 * c / (root**3 * half)


def _arcs(theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """sin(theta)/theta and (1 - cos(theta))/theta, and their derivatives, smooth at 0."""
    small = np.abs(theta) < _TINY
    t, t2 = np.where(small, 1.0, theta), theta * theta
    along = np.where(small, 1 - t2 / 6 + t2 * t2 / 120, np.sin(t) / t)
    across = np.where(small, theta / 2 - theta * t2 / 24 + theta * t2 * t2 / 720, 2 * np.sin(t / 2) ** 2 / t)
    by_along = np.where(small, -theta / 3 + theta * t2 / 30 - theta * t2 * t2 / 840, (np.cos(t) - along) / t)
    by_across = np.where(small, 0.5 - t2 / 8 + t2 * t2 / 144, (np.sin(t) - across) / t)
    return along, across, by_along, by_across


def _turned(x: FloatArray, theta: FloatArray, dt: float) -> FloatArray:
    along, across, _, _ = _arcs(theta)
    moved = x.copy()
    moved[..., :2] += dt * _rotated(x[..., 2:4], along, across)
    moved[..., 2:4] = _rotated(x[..., 2:4], np.cos(theta), np.sin(theta))
    return moved


def _turned_jacobian(x: FloatArray, theta: FloatArray, by_state: FloatArray, dt: float) -> FloatArray:
    """by_state (..., 5): derivative of theta."""
    along, across, by_along, by_across = _arcs(theta)
    v, c, s = x[..., 2:4], np.cos(theta), np.sin(theta)
    J = np.zeros((*x.shape, x.shape[-1]))
    J[...] = np.eye(x.shape[-1])
    for rows, a, b in ((slice(0, 2), dt * along, dt * across), (slice(2, 4), c, s)):
        J[..., rows, 2:4] = a[..., None, None] * np.eye(2) + b[..., None, None] * np.array([[0.0, -1.0], [1.0, 0.0]])
    J[..., :2, :] += dt * _rotated(v, by_along, by_across)[..., :, None] * by_state[..., None, :]
    J[..., 2:4, :] += _rotated(v, -s, c)[..., :, None] * by_state[..., None, :]
    return J


def _rotated(v: FloatArray, c: FloatArray, s: FloatArray) -> FloatArray:
    """(c I + s J) v."""
    return np.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], axis=-1)

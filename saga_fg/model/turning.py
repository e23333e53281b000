"""Motion along circles and known courses: coordinated turn, kinematic bicycle, turn rate as input.

Motion along circles: coordinated turn and kinematic bicycle.

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

Curvilinear motion along known courses: a vehicle's heading and turn rate are inputs of an interval.

Of a vehicle with heading h, u = (cos h, sin h), position, velocity and acceleration move along u by the generator A_1,
and across u by A_2, in which an acceleration fades at once (`Curvilinear`). Its velocity turns by an angle theta:

    F0 = exp(A_1 dt) (x) u u^T + exp(A_2 dt) (x) (I - u u^T)
    theta = c tau (1 - exp(-dt / tau))                        c: turn rate at the start, tau: its time constant
    x0 = x with  a <- a - brake u                             brake: u . a of a vehicle that would else reverse, or 0
    (F0 x0)_v += r dt u,   (F0 x0)_p += r dt^2 / 2 u          r: acceleration to the speed of earlier traffic, or 0
    v' = R(theta) (F0 x0)_v,   a' = R(theta) (F0 x0)_a
    p' = p + sin(theta / 2) / (theta / 2) R(theta / 2) ((F0 x0)_p - p)

Wheels roll along the course: of a vehicle that nobody detects, what of the velocity is across it may fade at a rate k.
With n the normal of h + theta, and n_m that of h + theta / 2:

    v', a'  times  I - n n^T (1 - exp(-k dt))
    p' - p  times  I - n_m n_m^T (1 - (1 - exp(-k dt)) / (k dt))
    q  is raised by  2 k s^2                    from which the velocity across has the variance s^2 at last

The chord is exact for a constant speed and a constant rate; where the rate fades or the speed changes it is near.

    Q = Q_1 (x) u u^T + Q_2 (x) (I - u u^T),   Q_k = int exp(A_k s) Qc_k exp(A_k s)^T ds,   Qc_2: + q on the velocity
    q = 2 T |v|^2 var(c)

q is the acceleration across the course that an uncertain turn rate makes: its errors are taken for white, of a
correlation time T = `RATE_CORRELATION`. Q is not rotated within the interval.

With constant velocity and tau infinite this is the coordinated turn, whose turn rate is part
of the state and makes it nonlinear. Here it is estimated beside the joint state, and recorded with the interval as the
edges are: given the record the motion is linear. Sources: Bar-Shalom, Li and Kirubarajan, Estimation with Applications
to Tracking and Navigation (2001), section 11.7.1; Best and Norton (1997) for the noise along and across the heading;
Singer (1970) for the first-order decay.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from saga_fg.kernels.paths import course_inputs, course_motions
from saga_fg.model.discretisation import linear_motions
from saga_fg.model.motion import Curvilinear, NodeType
from saga_fg.model.scene_graph import MatchedMotion
from saga_fg.numerics.arrays import Columns, FloatArray, IntArray, unchecked
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


RATE_CORRELATION = 1.0  # s
_LEAST_TIME = 1e-3  # s, so that a fading time of 0 divides nothing by 0: the rate is gone at once
_LEAST = 1e-9  # time constants, so that nothing is divided by 0
_P, _V, _A = slice(0, 2), slice(2, 4), slice(4, 6)


class Unseen(NamedTuple):
    """Of n nodes that are not seen: settling and pull (n,) as in `KnownCourses`, variance across (n,) of the velocity
    across, (m/s)^2."""

    settling: FloatArray
    across: FloatArray
    pull: FloatArray


@dataclass(frozen=True, eq=False)
class KnownCourses(Columns):
    """n nodes of one `Curvilinear` type: ids (n,), heading (n,) rad.

    rate           (n,) turn rate, rad/s, left is positive
    lateral_noise  (n,) q above, m^2/s^3
    brake          (n, 2) mean acceleration that is taken away, m/s^2
    settling       (n,) k above, 1/s, 0 for velocities across that stay
    pull           (n,) r above, m/s^2
    """

    ids: IntArray
    heading: FloatArray
    rate: FloatArray
    lateral_noise: FloatArray
    brake: FloatArray
    settling: FloatArray
    pull: FloatArray
    node_type: NodeType

    @classmethod
    def of(
        cls,
        node_type: NodeType,
        ids: IntArray,
        heading: FloatArray,
        rate: FloatArray,
        rate_variance: FloatArray,
        mean: FloatArray,
        dt: float,
        unseen: Unseen | None = None,
    ) -> KnownCourses:
        """The courses over the next `dt` s of nodes with states `mean` (n, 6); rate_variance (n,) rad^2/s^2."""
        settling, across, pull = unseen or Unseen(*np.zeros((3, len(ids))))
        noise, brake = course_inputs(heading, rate_variance, mean, settling, across, dt, RATE_CORRELATION)
        return cls(ids, heading, rate, noise, brake, settling, pull, node_type)

    def predicted(self, dt: float, scale: FloatArray) -> tuple[KnownCourses, MatchedMotion]:
        """dt seconds later, and the motions until then; scale (n,) of the process noise."""
        motion = self.node_type.motion
        assert isinstance(motion, Curvilinear)
        tau = max(motion.turn_time, _LEAST_TIME)
        theta = self.rate * turning_time(motion, dt)
        F, b, Q = course_motions(
            self.heading,
            theta,
            self.lateral_noise,
            self.brake,
            self.settling,
            self.pull,
            scale,
            dt,
            _LEAST,
            *_one_axis(motion, dt),
        )
        changed = {"heading": self.heading + theta, "rate": self.rate * np.exp(-dt / tau)}
        later = unchecked(KnownCourses, **self.__dict__ | changed | {"brake": np.zeros_like(self.brake)})
        return later, MatchedMotion(F, b, Q)


@lru_cache(maxsize=64)  # many sensors have one interval, again and again
def _one_axis(motion: Curvilinear, dt: float) -> tuple[FloatArray, FloatArray]:
    """F and Q (3, 3, 3) along the heading, across it, and across it of white acceleration of density 1."""
    (A_1, Qc_1), (A_2, Qc_2) = motion.along, motion.across
    white = np.diag([0.0, 1.0, 0.0])
    return linear_motions(np.stack([A_1, A_2, A_2]), np.stack([Qc_1, Qc_2, white]), dt)


def turning_time(motion: Curvilinear, dt: float) -> float:
    """The time, s, in which an undiminished rate turns as far as one that fades does within `dt`."""
    tau = max(motion.turn_time, _LEAST_TIME)
    return float(tau * -np.expm1(-dt / tau))

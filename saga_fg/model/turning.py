"""Motion along circles and known courses: coordinated turn, and turn rate as input.

The coordinated turn. The state has a Cartesian velocity, so that what acts on positions and velocities (interactions,
detections, range rates) finds it as in every other state, and nothing is singular at speed 0, as a course would be.
Position p and velocity v turn by the angle theta = c dt within the interval dt, at the turn rate c, rad/s, with
J = ((0, -1), (1, 0)):

    v' = R(theta) v,   p' = p + dt S(theta) v,   c' = c,   S(theta) = sin(theta) / theta I + (1 - cos(theta)) / theta J

which solves dp/dt = v, dv/dt = c J v exactly. Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to
Tracking and Navigation (2001), section 11.7.1. S and its derivative are smooth at theta = 0, where the motion is that
of constant velocity.

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
from typing import ClassVar, NamedTuple

import numpy as np

from saga_fg.kernels.paths import course_inputs, course_motions
from saga_fg.model.discretisation import linear_motions
from saga_fg.model.motion import Curvilinear, NodeType
from saga_fg.model.scene_graph import OwnMotions
from saga_fg.numerics import Columns, FloatArray, IntArray, unchecked
from saga_fg.settings import NonNegative, Settings, setting

_TINY = 1e-2  # rad; below, series
TURN_NOISE = 0.05  # spectral density of the random walk of the turn rate, rad^2/s^3


@dataclass(frozen=True)
class CoordinatedTurn(Settings):
    """A turn of nearly constant rate and speed."""

    acceleration_noise: NonNegative = setting(2.0, "spectral density of the acceleration, m^2/s^3; usual 0.3 to 3")

    components: ClassVar[tuple[str, ...]] = ("x", "y", "vx", "vy", "turn_rate")
    generator: ClassVar[FloatArray] = np.diag([1.0, 1.0, 0.0], k=2)  # dp/dt = v
    initial_deviation: ClassVar[FloatArray] = np.array([1.0, 1.0, 1.0, 1.0, 0.2])  # where nothing is measured

    @property
    def diffusion(self) -> FloatArray:
        return np.diag([0.0, 0.0, self.acceleration_noise, self.acceleration_noise, TURN_NOISE])

    def flow(self, x: FloatArray, dt: float) -> FloatArray:
        """States (..., 5) after dt seconds; dt may be negative."""
        theta = x[..., 4] * dt
        along, across, _, _ = _arcs(theta)
        moved = x.copy()
        moved[..., :2] += dt * _rotated(x[..., 2:4], along, across)
        moved[..., 2:4] = _rotated(x[..., 2:4], np.cos(theta), np.sin(theta))
        return moved

    def flow_jacobian(self, x: FloatArray, dt: float) -> FloatArray:
        """Derivative (..., 5, 5) of `flow`."""
        theta, v = x[..., 4] * dt, x[..., 2:4]
        along, across, by_along, by_across = _arcs(theta)
        c, s = np.cos(theta), np.sin(theta)
        J = np.zeros((*x.shape, 5))
        J[...] = np.eye(5)
        for rows, a, b in ((slice(0, 2), dt * along, dt * across), (slice(2, 4), c, s)):
            J[..., rows, 2:4] = _rotated(np.eye(2), a[..., None], b[..., None]).swapaxes(-1, -2)
        J[..., :2, 4] = dt * dt * _rotated(v, by_along, by_across)
        J[..., 2:4, 4] = dt * _rotated(v, -s, c)
        return J


def _arcs(theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """sin(theta)/theta and (1 - cos(theta))/theta, and their derivatives, smooth at 0."""
    small = np.abs(theta) < _TINY
    t, t2 = np.where(small, 1.0, theta), theta * theta
    along = np.where(small, 1 - t2 / 6 + t2 * t2 / 120, np.sin(t) / t)
    across = np.where(small, theta / 2 - theta * t2 / 24 + theta * t2 * t2 / 720, 2 * np.sin(t / 2) ** 2 / t)
    by_along = np.where(small, -theta / 3 + theta * t2 / 30 - theta * t2 * t2 / 840, (np.cos(t) - along) / t)
    by_across = np.where(small, 0.5 - t2 / 8 + t2 * t2 / 144, (np.sin(t) - across) / t)
    return along, across, by_along, by_across


def _rotated(v: FloatArray, c: FloatArray, s: FloatArray) -> FloatArray:
    """(c I + s J) v."""
    return np.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], axis=-1)


RATE_CORRELATION = 1.0  # s
_MIN_TIME = 1e-3  # s, so that a fading time of 0 divides nothing by 0: the rate is gone at once
_MIN_RATE = 1e-9  # 1/s, so that nothing is divided by 0
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
    def from_turn_rates(
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
        return cls(
            ids=ids,
            heading=heading,
            rate=rate,
            lateral_noise=noise,
            brake=brake,
            settling=settling,
            pull=pull,
            node_type=node_type,
        )

    def predicted(self, dt: float, scale: FloatArray) -> tuple[KnownCourses, OwnMotions]:
        """dt seconds later, and the motions until then; scale (n,) of the process noise."""
        motion = self.node_type.motion
        assert isinstance(motion, Curvilinear)
        tau = max(motion.turn_time, _MIN_TIME)
        theta = self.rate * turning_time(motion, dt)
        F_axis, Q_axis = _one_axis(motion, dt)
        F, b, Q = course_motions(
            heading=self.heading,
            theta=theta,
            lateral_noise=self.lateral_noise,
            brake=self.brake,
            settling=self.settling,
            pull=self.pull,
            scale=scale,
            dt=dt,
            least=_MIN_RATE,
            F_axis=F_axis,
            Q_axis=Q_axis,
        )
        changed = {"heading": self.heading + theta, "rate": self.rate * np.exp(-dt / tau)}
        later = unchecked(KnownCourses, **self.__dict__ | changed | {"brake": np.zeros_like(self.brake)})
        return later, OwnMotions(F, b, Q)


@lru_cache(maxsize=64)  # many sensors have one interval, again and again
def _one_axis(motion: Curvilinear, dt: float) -> tuple[FloatArray, FloatArray]:
    """F and Q (3, 3, 3) along the heading, across it, and across it of white acceleration of density 1."""
    (A_1, Qc_1), (A_2, Qc_2) = motion.along, motion.across
    white = np.diag([0.0, 1.0, 0.0])
    return linear_motions(np.stack([A_1, A_2, A_2]), np.stack([Qc_1, Qc_2, white]), dt)


def turning_time(motion: Curvilinear, dt: float) -> float:
    """The time, s, in which an undiminished rate turns as far as one that fades does within `dt`."""
    tau = max(motion.turn_time, _MIN_TIME)
    return float(tau * -np.expm1(-dt / tau))

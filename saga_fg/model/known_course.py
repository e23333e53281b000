r"""Curvilinear motion along known courses: a vehicle's heading and turn rate are inputs of an interval.

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

With constant velocity and tau infinite this is the coordinated turn (`saga_fg.model.turning`), whose turn rate is part
of the state and makes it nonlinear. Here it is estimated beside the joint state, and recorded with the interval as the
edges are: given the record the motion is linear. Sources: Bar-Shalom, Li and Kirubarajan, Estimation with Applications
to Tracking and Navigation (2001), section 11.7.1; Best and Norton (1997) for the noise along and across the heading;
Singer (1970) for the first-order decay.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from saga_fg.kernels.compilation import compiled_by
from saga_fg.kernels.turning import Turning, course_inputs, course_motions
from saga_fg.model.discretisation import linear_motions
from saga_fg.model.motion import Curvilinear, NodeType
from saga_fg.model.scene_graph import MatchedMotion
from saga_fg.numerics.arrays import FloatArray, IntArray, unchecked
from saga_fg.numerics.columns import Columns

RATE_CORRELATION = 1.0  # s
_LEAST_TIME = 1e-3  # s, so that a fading time of 0 divides nothing by 0: the rate is gone at once
_LEAST = 1e-9  # time constants, so that nothing is divided by 0
_P, _V, _A = slice(0, 2), slice(2, 4), slice(4, 6)


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
        settling: FloatArray | None = None,
        across: FloatArray | None = None,
        pull: FloatArray | None = None,
    ) -> KnownCourses:
        """The courses over the next `dt` s of nodes with states `mean` (n, 6); rate_variance (n,) rad^2/s^2; settling
        across (n,) variance of the velocity across, (m/s)^2; these and pull 0 if not given."""
        settling, across, pull = (np.zeros(len(ids)) if each is None else each for each in (settling, across, pull))
        noise, brake = _inputs(heading, rate_variance, mean, settling, across, dt, RATE_CORRELATION)
        return cls(ids, heading, rate, noise, brake, settling, pull, node_type)

    def predicted(self, dt: float, scale: FloatArray) -> tuple[KnownCourses, MatchedMotion]:
        """dt seconds later, and the motions until then; scale (n,) of the process noise."""
        motion = self.node_type.motion
        assert isinstance(motion, Curvilinear)
        tau = max(motion.turn_time, _LEAST_TIME)
        theta = self.rate * turning_time(motion, dt)
        F, b, Q = _motions(
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


@compiled_by(course_inputs)
def _inputs(
    heading: FloatArray,
    rate_variance: FloatArray,
    mean: FloatArray,
    settling: FloatArray,
    across: FloatArray,
    dt: float,
    correlation: float,
) -> tuple[FloatArray, FloatArray]:
    u = _unit(heading)
    speed, acceleration = (mean[:, _V] * u).sum(axis=1), (mean[:, _A] * u).sum(axis=1)
    reverses = (acceleration < 0) & (speed + acceleration * dt < 0)
    square = (mean[:, _V] ** 2).sum(axis=1)
    noise = 2 * (correlation * rate_variance * square + settling * across)
    return noise, np.where(reverses, acceleration, 0.0)[:, None] * u


@compiled_by(course_motions)
def _motions(
    heading: FloatArray,
    theta: FloatArray,
    lateral_noise: FloatArray,
    brake: FloatArray,
    settling: FloatArray,
    pull: FloatArray,
    scale: FloatArray,
    dt: float,
    least: float,
    F_axis: FloatArray,
    Q_axis: FloatArray,
) -> Turning:
    u = _unit(heading)
    ahead = u[:, :, None] * u[:, None]
    aside = np.eye(2) - ahead
    F = _planar(F_axis[0], ahead) + _planar(F_axis[1], aside)
    Q = _planar(Q_axis[0], ahead) + _planar(Q_axis[1] + lateral_noise[:, None, None] * Q_axis[2], aside)
    b = -(F[:, :, _A] @ brake[:, :, None])[:, :, 0]
    pulled = pull[:, None] * u
    b[:, _P] += dt * dt / 2 * pulled
    b[:, _V] += dt * pulled
    chord, turn = np.sinc(theta / (2 * np.pi))[:, None, None] * _rotation(theta / 2), _rotation(theta)
    if settling.any():
        passed = np.maximum(settling * dt, least)
        faded = -np.expm1(-passed)
        chord = _less_across(heading + theta / 2, 1 - faded / passed) @ chord
        turn = _less_across(heading + theta, faded) @ turn
    F[:, _P, 2:], b[:, _P] = chord @ F[:, _P, 2:], (chord @ b[:, _P, None])[:, :, 0]
    for part in (_V, _A):
        F[:, part], b[:, part] = turn @ F[:, part], (turn @ b[:, part, None])[:, :, 0]
    return F, b, Q * scale[:, None, None]


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


def _planar(one_axis: FloatArray, projection: FloatArray) -> FloatArray:
    """(n, 6, 6) of the matrix, (3, 3) or (n, 3, 3), of one axis; projection (n, 2, 2) on that axis."""
    spread = np.broadcast_to(one_axis, (len(projection), 3, 3))[:, :, None, :, None] * projection[:, None, :, None]
    return spread.reshape(len(projection), 6, 6)


def _unit(heading: FloatArray) -> FloatArray:
    return np.stack([np.cos(heading), np.sin(heading)], axis=-1)


def _less_across(course: FloatArray, share: FloatArray) -> FloatArray:
    """Matrices (n, 2, 2) that take away a share (n,) of what is across a course (n,)."""
    normal = _unit(course + np.pi / 2)
    return np.asarray(np.eye(2) - share[:, None, None] * normal[:, :, None] * normal[:, None])


def _rotation(theta: FloatArray) -> FloatArray:
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)

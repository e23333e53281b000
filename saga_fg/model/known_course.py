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

from saga_fg.kernels.turning import course_inputs, course_motions
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

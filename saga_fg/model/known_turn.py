r"""Motion along a known, fading turn: any linear motion whose velocity turns by a given angle within an interval.

    theta = c tau (1 - exp(-dt / tau))                        c: turn rate at the start, tau: its time constant
    v' = R(theta) (exp(A dt) x)_v,   a' = R(theta) (exp(A dt) x)_a
    p' = p + sin(theta / 2) / (theta / 2) R(theta / 2) ((exp(A dt) x)_p - p)

The chord is exact for a constant speed and a constant rate; where the rate fades or the speed changes it is near. Q is
that of straight motion, not rotated.

Wheels roll along the course h, that of the path, which turns with the velocity; what of the velocity is across it
fades at the rate k. With n the normal of h + theta, and n_m that of h + theta / 2:

    v', a'  times  I - n n^T (1 - exp(-k dt))
    p' - p  times  I - n_m n_m^T (1 - (1 - exp(-k dt)) / (k dt))

With constant velocity and tau infinite this is the coordinated turn (`saga_fg.model.turning`), whose turn rate is part
of the state and makes it nonlinear. Here the turn rate is estimated beside the joint state, and recorded with the
interval as the edges are: given the record the motion is linear. Sources: Bar-Shalom, Li and Kirubarajan, Estimation
with Applications to Tracking and Navigation (2001), section 11.7.1; the first-order decay is that of Singer (1970).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from saga_fg.model.discretisation import discretise
from saga_fg.model.interactions import POSITION, VELOCITY
from saga_fg.model.modes import Mixture
from saga_fg.model.motion import NodeType
from saga_fg.model.scene_graph import MatchedMotion, SceneGraph
from saga_fg.numerics.arrays import FloatArray, IntArray

ACCELERATION = ("ax", "ay")
_LEAST = 1e-9  # time constants, so that nothing is divided by 0


@dataclass(frozen=True, eq=False)
class KnownTurns:
    """n nodes of one type, linear and with a velocity, that turn: ids (n,), rate (n,) rad/s, left is positive.

    fading_time: time constant of the rates, s
    course (n,) of the paths, rad, and course_rate (n,) >= 0, at which velocities across them fade, 1/s; None: never
    """

    node_type: NodeType
    ids: IntArray
    rate: FloatArray
    fading_time: float
    course: FloatArray | None = None
    course_rate: FloatArray | None = None

    def select(self, rows: IntArray) -> KnownTurns:
        """Some nodes."""
        course = (None if column is None else column[rows] for column in (self.course, self.course_rate))
        return KnownTurns(self.node_type, self.ids[rows], self.rate[rows], self.fading_time, *course)

    def predicted(self, dt: float, scale: FloatArray) -> tuple[KnownTurns, MatchedMotion]:
        """dt seconds later, and the motions until then; scale (n,) of the process noise."""
        own, Q = _own_motion(self.node_type, dt)
        theta = self.rate * self.fading_time * -np.expm1(-dt / self.fading_time)
        turned, chord = _rotation(theta), np.sinc(theta / (2 * np.pi))[:, None, None] * _rotation(theta / 2)
        later = replace(self, rate=self.rate * np.exp(-dt / self.fading_time))
        if self.course is not None and self.course_rate is not None:
            passed = np.maximum(self.course_rate * dt, _LEAST)
            faded = -np.expm1(-passed)
            turned = _without(self.course + theta, faded) @ turned
            chord = _without(self.course + theta / 2, 1 - faded / passed) @ chord
            later = replace(later, course=self.course + theta)
        F = np.tile(own, (len(self.ids), 1, 1))
        p = self.node_type.index(POSITION)
        others = np.setdiff1d(np.arange(self.node_type.dim), p)
        F[:, p[:, None], others] = chord @ F[:, p[:, None], others]
        for names in (VELOCITY, ACCELERATION):
            if self.node_type.has(names):
                rows = self.node_type.index(names)
                F[:, rows] = turned @ F[:, rows]
        return later, MatchedMotion(F, np.zeros((len(F), len(own))), Q * scale[:, None, None])


def turns_as_known(node_type: NodeType) -> bool:
    """Return True if a known turn can act on nodes of this type: it has a velocity, and no turns of its own."""
    return node_type.has(POSITION + VELOCITY) and node_type.flow is None and not isinstance(node_type.motion, Mixture)


def _own_motion(node_type: NodeType, dt: float) -> tuple[FloatArray, FloatArray]:
    alone = discretise(SceneGraph.of([0], node_type), dt)
    return alone.F[0].values[0], alone.Q[0].values[0]


def _without(course: FloatArray, share: FloatArray) -> FloatArray:
    """Matrices (n, 2, 2) that take away a share (n,) of what is across a course (n,)."""
    normal = np.stack([-np.sin(course), np.cos(course)], axis=-1)
    return np.asarray(np.eye(2) - share[:, None, None] * normal[:, :, None] * normal[:, None, :])


def _rotation(theta: FloatArray) -> FloatArray:
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)

r"""The Intelligent Driver Model as an interaction function: following a leader, and stopping.

    f(v, s, w) = a [ 1 - (v / v_free)^4 - (s* / s)^2 ],      s* = s0 + max(0, v T + v (v - w) / (2 sqrt(a b)))

is the acceleration at speed v with the gap s along the path, bumper to bumper, to a leader of speed w (Treiber,
Hennecke, Helbing 2000, doi 10.1103/PhysRevE.62.1805, equations 3 and 4). A line to stop at is a stationary leader.
Vehicles do not reverse, so braking is at most -v / t_stop. An edge of rate 1 / tau acts with the full acceleration,
linearised at the estimate (v', s', w'):

    dv_i/dt += rate tau u_i ( f + f_v (v - v') + f_s (s - s') + f_w (w - w') )

A vehicle does not start behind a stationary one, f <= max(v, w) / tau: parked cars and queues stay at rest. A gap of
at least `hidden_vehicle_gap` may hold an undetected vehicle, so that a driver does not speed up into it: he approaches
at most the speed of the leader, f <= (w - v) / tau, and before a line he keeps his speed at most, f <= 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from saga_fg.model.interactions import POSITION, VELOCITY, Needs, NodeTable, Triples, unit, velocity_triples
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.settings import NonNegative, Positive, PositiveOrInf, Settings, setting

LEAST_GAP = 0.5  # m; smaller gaps are below their own noise


class Linearised(NamedTuple):
    """An acceleration (E,), m/s^2, at the estimate, and its derivatives by v, s and w."""

    value: FloatArray
    by_speed: FloatArray
    by_gap: FloatArray
    by_leader: FloatArray

    def where(self, chosen: BoolArray, other: Linearised) -> Linearised:
        """Itself where `chosen` (E,), else `other`."""
        return Linearised(*(np.where(chosen, mine, its) for mine, its in zip(self, other, strict=True)))


@dataclass(frozen=True)
class IntelligentDriver(Settings):
    """A vehicle follows its leader, which is the source.

    The defaults are those of city traffic in Treiber and Kesting, Traffic Flow Dynamics (2013), table 11.2.
    """

    needs: ClassVar[Needs] = (POSITION + VELOCITY, POSITION + VELOCITY)
    free_speed: Positive = setting(
        15.0, "v_free: desired speed on a free road, m/s; usual the speed limit; higher: vehicles speed up further"
    )
    headway: Positive = setting(1.0, "T: desired time headway, s; usual 0.8 to 2; higher: larger gaps")
    standstill_gap: NonNegative = setting(2.0, "s0: gap at rest, bumper to bumper, m; usual 1 to 3")
    acceleration: Positive = setting(1.0, "a: maximum acceleration, m/s^2; usual 0.5 to 2")
    deceleration: Positive = setting(1.5, "b: comfortable deceleration, m/s^2; usual 1 to 3")
    max_deceleration: Positive = setting(
        6.0, "limit of the deceleration, m/s^2; usual 4 to 8; higher: harder braking is predicted"
    )
    stop_time: Positive = setting(
        0.4, "t_stop: time constant with which the last of the speed fades, s; usual 0.2 to 1; higher: slower stops"
    )
    hidden_vehicle_gap: PositiveOrInf = setting(
        7.0, "gap that may hold an undetected vehicle, into which nobody speeds up, m; .inf: there are none"
    )
    time_constant: Positive = setting(
        1.0,
        "tau: an edge of rate 1 / tau has the full acceleration of the law, s; higher: edges of one rate "
        "act more strongly",
    )

    def alone(self, v: FloatArray, s: FloatArray, w: FloatArray) -> Linearised:
        """f (E,) without an undetected vehicle in the gap; v, w >= 0 m/s, s m."""
        a, T, s = self.acceleration, self.headway, np.maximum(s, LEAST_GAP)
        root = 2 * math.sqrt(a * self.deceleration)
        dynamic = v * T + v * (v - w) / root
        share = (self.standstill_gap + np.maximum(dynamic, 0.0)) / s
        by_gap_wanted = -2 * a * share / s  # the derivative of f by s*
        closing = dynamic > 0
        below = v < self.free_speed
        free = np.where(below, 1 - (v / self.free_speed) ** 4, 0.0)
        by_free = np.where(below, -4 * v**3 / self.free_speed**4, 0.0)
        none = np.zeros_like(share)
        f = Linearised(
            a * (free - share**2),
            a * by_free + by_gap_wanted * np.where(closing, T + (2 * v - w) / root, 0.0),
            2 * a * share**2 / s,
            by_gap_wanted * np.where(closing, -v / root, 0.0),
        )
        hardest = Linearised(none - self.max_deceleration, none, none, none)
        halt = Linearised(-v / self.stop_time, none - 1 / self.stop_time, none, none)
        f = hardest.where(f.value < -self.max_deceleration, f)
        f = halt.where(f.value < halt.value, f)
        rate = np.where(np.maximum(v, w) < f.value * self.time_constant, 1 / self.time_constant, 0.0)
        start = Linearised(rate * np.maximum(v, w), rate * (v >= w), none, rate * (v < w))
        return start.where(rate > 0, f)

    def following(self, v: FloatArray, s: FloatArray, w: FloatArray) -> Linearised:
        """Acceleration (E,) behind a leader."""
        rate, none = 1 / self.time_constant, np.zeros_like(v)
        return self._capped(v, s, w, Linearised(rate * (w - v), none - rate, none, none + rate))

    def stopping(self, v: FloatArray, s: FloatArray) -> Linearised:
        """Acceleration (E,) before a line to stop at."""
        none = np.zeros_like(v)
        return self._capped(v, s, none, Linearised(none, none, none, none))

    def _capped(self, v: FloatArray, s: FloatArray, w: FloatArray, highest: Linearised) -> Linearised:
        """f, but at most `highest` where the gap has room for another vehicle."""
        f = self.alone(v, s, w)
        return highest.where((s >= self.hidden_vehicle_gap) & (highest.value < f.value), f)

    def triples(self, nodes: NodeTable, target: IntArray, source: IntArray) -> Triples:
        u_i, u_j = (unit(nodes.heading[rows]) for rows in (target, source))
        v, w = speed_along(nodes, target, u_i), speed_along(nodes, source, u_j)
        way = nodes.along(target, source)
        f = self.following(v, way.ahead - (nodes.length[target] + nodes.length[source]) / 2, w)
        at_rest = f._replace(value=f.value - f.by_leader * w)
        from_leader = self.time_constant * u_i[:, :, None] * u_j[:, None, :] * f.by_leader[:, None, None]
        return accelerated(nodes, target, source, u_i, v, at_rest, self.time_constant, from_leader, unit(way.direction))


def speed_along(nodes: NodeTable, rows: IntArray, u: FloatArray) -> FloatArray:
    """(E,) speeds of nodes `rows` along u (E, 2), m/s, not below 0."""
    return np.asarray(np.maximum(np.einsum("ei,ei->e", nodes.velocity[rows], u), 0.0))


def accelerated(
    nodes: NodeTable,
    target: IntArray,
    source: IntArray,
    u: FloatArray,
    v: FloatArray,
    f: Linearised,
    tau: float,
    by_leader: FloatArray | None = None,
    onward: FloatArray | None = None,
) -> Triples:
    """The triples of an acceleration f along u (E, 2), linearised at the speeds v (E,) and the gap along a path.

    by_leader: derivative (E, 2, 2) by the velocity of the source, whose part f leaves out; onward: direction (E, 2) of
    the path at the source, u if not given
    """
    onward = u if onward is None else onward
    along = tau * u[:, :, None] * u[:, None, :]
    gap = (nodes.position[source] * onward - nodes.position[target] * u).sum(axis=1)
    by_gap, by_speed = along * f.by_gap[:, None, None], along * f.by_speed[:, None, None]
    by_source = tau * u[:, :, None] * onward[:, None, :] * f.by_gap[:, None, None]
    constant = tau * u * (f.value - f.by_speed * v - f.by_gap * gap)[:, None]
    return velocity_triples(nodes, target, source, -by_gap, by_speed, by_source, by_leader, constant)

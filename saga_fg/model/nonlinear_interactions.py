"""Interaction functions that are not linear: accelerations by the states of two nodes.

p' = p + dt v + dt^2 / 2 a,        v' = v + dt a,         a = sum_j rate_j a_j(x, x_j), held over the interval

    following   a = f(v . u, r - length, w . u) u          d = p_leader - p, r = |d|, u = d / |d|, w the leader's
                                                           velocity, f of the Intelligent Driver Model
    repulsion   a = A exp( (`RADII` - r) / B ) u,           d from the neighbour, or the nearest point of a wall, to p

The second is the circular specification of the social force (Helbing, Farkas, Vicsek 2000, doi 10.1038/35035023,
equation 2 without body contact). The first is that of Treiber, Hennecke, Helbing (2000, doi
10.1103/PhysRevE.62.1805, equations 3 and 4) with round corners: at a corner a least-squares solution has no
linearisation, and solvers do not converge.

    f0 = a - g / (1 + (g / G)^4)^(1/4),    g = a (v / v_free)^4 + a (s* / s)^2,    G = a + `MAX_DECELERATION`
    s* = s0 + S(v T + v (v - w) / (2 sqrt(a b))),    S(x) = log(1 + e^x) for max(0, x), s likewise, m
    f  = -v / t_stop + h S((f0 + v / t_stop) / h)    for max(f0, -v / t_stop): vehicles do not reverse; h 0.05 m/s^2

Laws and their derivatives are continuous everywhere, or estimates do not settle where two walk into each other. Nearer
than w, r and u are the soft distance and its gradient (`factors.measurement`): the repulsion stays the downhill slope
of its potential A B exp( (`RADII` - r) / B ), and at distance zero nothing acts. w is 0.3 m, of vehicles 1 m: estimates
come so near, centres of road users do not; bodies are 0.46 m deep (Fruin, Pedestrian Planning and Design, 1971).
Of a wall of pieces k, from c_k along the unit vector t_k for L_k, with tau = t_k . (p - c_k) and h = 0.05 m,

    d_k = p - c_k - t_k h ( S(tau / h) - S((tau - L_k) / h) )        for tau clipped to 0 ... L_k
    a   = sum_k w_k a(d_k),     w_k ~ exp(-r_k / h)                  for the nearest piece

An edge rule whose `interaction` is one of these makes `NonlinearEdges` of a scene graph: a filter linearises them at
the start of the interval, smoothers wherever their estimates are. `interaction` gives the same law for factors by hand.

The Intelligent Driver Model as an interaction function: following a leader, and stopping.

    f(v, s, w) = a [ 1 - (v / v_free)^4 - (s* / s)^2 ],      s* = s0 + max(0, v T + v (v - w) / (2 sqrt(a b)))

is the acceleration at speed v with the gap s along the path, bumper to bumper, to a leader of speed w (Treiber,
Hennecke, Helbing 2000, doi 10.1103/PhysRevE.62.1805, equations 3 and 4). A line to stop at is a stationary leader.
Vehicles do not reverse, so braking is at most -v / t_stop. An edge of rate 1/s acts with the full acceleration,
linearised at the estimate (v', s', w'):

    dv_i/dt += rate u_i ( f + f_v (v - v') + f_s (s - s') + f_w (w - w') )

A vehicle does not start behind a stationary one, f <= max(v, w) / s: parked cars and queues stay at rest. A gap of
at least `HIDDEN_VEHICLE_GAP` may hold an undetected vehicle, so that a driver does not speed up into it: he approaches
at most the speed of the leader, f <= (w - v) / s, and before a line he keeps his speed at most, f <= 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol, runtime_checkable

import numpy as np
from scipy.special import expit, softmax

from factors.measurement import soft_distance
from saga_fg.model.interactions import POSITION, VELOCITY, Needs, NodeTable, Triples, unit, velocity_triples
from saga_fg.numerics import BoolArray, FloatArray, IntArray
from saga_fg.parts import part_kind
from saga_fg.settings import NonNegative, Positive, Settings, setting, settings_group

MIN_GAP = 0.5  # m; smaller gaps are below their own noise
MAX_DECELERATION = 6.0  # m/s^2, usual 4 to 8
STOP_TIME = 0.4  # t_stop, s, with which the last of the speed fades
HIDDEN_VEHICLE_GAP = 7.0  # m: a car that no sensor sees fits in, so that nobody speeds up into such a gap
STRENGTH, FALLOFF = 2.0, 0.5  # A, m/s^2, and B, m, of the social force
RADII = 0.6  # m, sum of those of two bodies


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
    standstill_gap: NonNegative = setting(
        2.0, "s0: gap at rest, bumper to bumper, m; usual 1 to 3; higher: longer gaps"
    )
    acceleration: Positive = setting(1.0, "a: maximum acceleration, m/s^2; usual 0.5 to 2; higher: quicker starts")
    deceleration: Positive = setting(1.5, "b: comfortable deceleration, m/s^2; usual 1 to 3; higher: later braking")

    def alone(self, v: FloatArray, s: FloatArray, w: FloatArray) -> Linearised:
        """f (E,) without an undetected vehicle in the gap; v, w >= 0 m/s, s m."""
        a, T, s = self.acceleration, self.headway, np.maximum(s, MIN_GAP)
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
        hardest = Linearised(none - MAX_DECELERATION, none, none, none)
        halt = Linearised(-v / STOP_TIME, none - 1 / STOP_TIME, none, none)
        f = hardest.where(f.value < -MAX_DECELERATION, f)
        f = halt.where(f.value < halt.value, f)
        start = Linearised(np.maximum(v, w), np.where(v < w, 0.0, 1.0), none, np.where(v < w, 1.0, 0.0))
        return start.where(start.value < f.value, f)

    def following(self, v: FloatArray, s: FloatArray, w: FloatArray) -> Linearised:
        """Acceleration (E,) behind a leader."""
        none = np.zeros_like(v)
        return self._capped(v, s, w, Linearised(w - v, none - 1, none, none + 1))

    def stopping(self, v: FloatArray, s: FloatArray) -> Linearised:
        """Acceleration (E,) before a line to stop at."""
        none = np.zeros_like(v)
        return self._capped(v, s, none, Linearised(none, none, none, none))

    def _capped(self, v: FloatArray, s: FloatArray, w: FloatArray, highest: Linearised) -> Linearised:
        """f, but at most `highest` where the gap has room for another vehicle."""
        f = self.alone(v, s, w)
        return highest.where((s >= HIDDEN_VEHICLE_GAP) & (highest.value < f.value), f)

    def triples(self, nodes: NodeTable, target: IntArray, source: IntArray) -> Triples:
        u_i, u_j = (unit(nodes.heading[rows]) for rows in (target, source))
        v, w = speed_along(nodes, target, u_i), speed_along(nodes, source, u_j)
        place = nodes.along(target, source)
        f = self.following(v, place.ahead - (nodes.length[target] + nodes.length[source]) / 2, w)
        at_rest = f._replace(value=f.value - f.by_leader * w)
        from_leader = u_i[:, :, None] * u_j[:, None, :] * f.by_leader[:, None, None]
        path = PathEnds(u_i, unit(place.direction), v)
        return accelerated(nodes, target, source, path, at_rest, from_leader)


def speed_along(nodes: NodeTable, rows: IntArray, u: FloatArray) -> FloatArray:
    """(E,) speeds of nodes `rows` along u (E, 2), m/s, not below 0."""
    return np.asarray(np.maximum(np.einsum("ei,ei->e", nodes.velocity[rows], u), 0.0))


class PathEnds(NamedTuple):
    """Unit directions (E, 2) of the path at the target and at the source, and the speeds (E,) of the target, m/s."""

    at_target: FloatArray
    at_source: FloatArray
    speed: FloatArray


def accelerated(
    nodes: NodeTable,
    target: IntArray,
    source: IntArray,
    path: PathEnds,
    f: Linearised,
    by_leader: FloatArray | None = None,
) -> Triples:
    """The triples of an acceleration f along a path, linearised at the speed and the gap along it.

    by_leader: derivative (E, 2, 2) by the velocity of the source, whose part f leaves out
    """
    u, onward, v = path
    along = u[:, :, None] * u[:, None, :]
    gap = (nodes.position[source] * onward - nodes.position[target] * u).sum(axis=1)
    by_gap, by_speed = along * f.by_gap[:, None, None], along * f.by_speed[:, None, None]
    by_source = u[:, :, None] * onward[:, None, :] * f.by_gap[:, None, None]
    constant = u * (f.value - f.by_speed * v - f.by_gap * gap)[:, None]
    return velocity_triples(nodes, target, source, -by_gap, by_speed, by_source, by_leader, constant)


_BEHIND = 1.0  # w of the first, m; a leader's centre is farther ahead, even of bicycles
_BESIDE = 0.3  # w of the second, m; bodies are deeper
_ROUND = 0.05  # h, m; no map knows the ends and corners of walls better
_HALT = 0.05  # m/s^2
_FAR = 1e6  # m; a piece so far away weighs nothing


class Accelerations(NamedTuple):
    """Accelerations (E, 2) of E pairs, m/s^2, and derivatives (E, 2, 4) by (p, v) of the node and of the other."""

    value: FloatArray
    by_own: FloatArray
    by_other: FloatArray


@part_kind("interaction", "saga_fg.interactions")
@runtime_checkable
class AccelerationLaw(Protocol):
    """Acceleration of a node with position and velocity by another; an edge of rate 1/s acts with all of it."""

    @property
    def alone(self) -> FloatArray:
        """Default argument `given` of `accelerations`, for a pair without a node table."""

    @property
    def needs(self) -> Needs:
        """Components that target and source must have."""

    def given(self, nodes: NodeTable, target: IntArray, source: IntArray) -> FloatArray:
        """Parameters (E, ...) of the edges source[k] -> target[k] that do not depend on states."""

    def accelerations(self, own: FloatArray, other: FloatArray, given: FloatArray) -> Accelerations:
        """At (p, v) of the nodes (E, 4) and of the others, whose v is 0 if they have none."""


@dataclass(frozen=True)
class SmoothDriver(Settings):
    """A vehicle follows its leader, the source: an intelligent driver whose law has no corners."""

    needs: ClassVar[Needs] = (POSITION + VELOCITY, POSITION + VELOCITY)
    alone: ClassVar[FloatArray] = np.array(4.5)  # m that vehicles fill of the distance, where no boxes are known
    driver: IntelligentDriver = settings_group(IntelligentDriver, "parameters of the driver")

    def given(self, nodes: NodeTable, target: IntArray, source: IntArray) -> FloatArray:
        filled = (nodes.length[target] + nodes.length[source]) / 2
        return np.where(filled > 0, filled, self.alone)

    def accelerations(self, own: FloatArray, other: FloatArray, given: FloatArray) -> Accelerations:
        soft = soft_distance(other[..., :2] - own[..., :2], _BEHIND)
        u, turn = soft.direction, soft.bend()
        v, w = ((u * state[..., 2:]).sum(axis=-1) for state in (own, other))
        f = smooth_acceleration(self.driver, v, soft.value - given, w)
        along = u[..., :, None] * u[..., None, :]
        by_turn = f.by_speed[..., None] * own[..., 2:] + f.by_leader[..., None] * other[..., 2:]
        gradient = (turn @ by_turn[..., None])[..., 0] + f.by_gap[..., None] * u
        by_d = u[..., :, None] * gradient[..., None, :] + f.value[..., None, None] * turn
        by_own = np.concatenate([-by_d, f.by_speed[..., None, None] * along], axis=-1)
        by_other = np.concatenate([by_d, f.by_leader[..., None, None] * along], axis=-1)
        return Accelerations(f.value[..., None] * u, by_own, by_other)


@dataclass(frozen=True)
class SocialForce:
    """A pedestrian keeps away from another, or from a wall: from the nearest point of the source's outline."""

    needs: ClassVar[Needs] = (POSITION + VELOCITY, POSITION)
    alone: ClassVar[FloatArray] = np.zeros((1, 4))

    def given(self, nodes: NodeTable, target: IntArray, source: IntArray) -> FloatArray:
        """(E, k, 4) pieces of the outlines, both ends from the source's position; those that are missing far away."""
        lines = {j: nodes.outline[j] - nodes.position[j] for j in set(source.tolist()) if j in nodes.outline}
        pieces = {j: np.concatenate([line[:-1], line[1:]], axis=1) for j, line in lines.items()}
        found = [pieces.get(j, np.zeros((1, 4))) for j in source.tolist()]
        padded = np.full((len(source), max(map(len, found), default=1), 4), _FAR)
        for row, ends in enumerate(found):
            padded[row, : len(ends)] = ends
        return padded

    def accelerations(self, own: FloatArray, other: FloatArray, given: FloatArray) -> Accelerations:
        apart, by_offset = _from_pieces(own[..., :2] - other[..., :2], given)
        soft = soft_distance(apart, _BESIDE)
        distance, away = soft.value, soft.direction
        weight = softmax(-distance / _ROUND, axis=-1)[..., None, None]
        force = STRENGTH * np.exp((RADII - distance) / FALLOFF)[..., None]
        pushes = force * away
        by_apart = force[..., None] * (soft.bend() - away[..., :, None] * away[..., None, :] / FALLOFF)
        by_distance = (away[..., None, :] @ by_offset)[..., 0, :]
        nearer = ((weight[..., 0] * by_distance).sum(axis=-2, keepdims=True) - by_distance) / _ROUND  # d log(weight)
        by_position = (weight * (by_apart @ by_offset + pushes[..., :, None] * nearer[..., None, :])).sum(axis=-3)
        by_own = np.concatenate([by_position, np.zeros_like(by_position)], axis=-1)
        return Accelerations((weight[..., 0] * pushes).sum(axis=-2), by_own, -by_own)


def nearest_offset(offset: FloatArray, pieces: FloatArray) -> FloatArray:
    """Vectors (..., 2) to `offset` from the nearest point of segments (..., k, 4)."""
    start, step = pieces[..., :2], pieces[..., 2:] - pieces[..., :2]
    squared = (step**2).sum(axis=-1)
    share = ((offset[..., None, :] - start) * step).sum(axis=-1) / np.where(squared > 0, squared, 1.0)
    apart = offset[..., None, :] - start - np.clip(share, 0.0, 1.0)[..., None] * step
    nearest = np.argmin((apart**2).sum(axis=-1), axis=-1)[..., None]
    return np.take_along_axis(apart, nearest[..., None], axis=-2)[..., 0, :]


def _from_pieces(offset: FloatArray, pieces: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Vectors (..., k, 2) to `offset` from segments (..., k, 4), smooth past their ends; derivatives (..., k, 2, 2)."""
    start, step = pieces[..., :2], pieces[..., 2:] - pieces[..., :2]
    length = np.hypot(step[..., 0], step[..., 1])
    t = step / np.where(length > 0, length, 1.0)[..., None]
    from_start = offset[..., None, :] - start
    ends = ((from_start * t).sum(axis=-1)[..., None] - np.stack([0 * length, length], axis=-1)) / _ROUND
    along = -_ROUND * np.diff(np.logaddexp(0.0, ends), axis=-1)
    share = -np.diff(expit(ends), axis=-1)
    return from_start - along * t, np.eye(2) - (share * t)[..., :, None] * t[..., None, :]


def smooth_acceleration(driver: IntelligentDriver, v: FloatArray, s: FloatArray, w: FloatArray) -> Linearised:
    """f (...), m/s^2, at speeds v, gaps s, m, and leaders' speeds w, with its derivatives."""
    a = driver.acceleration
    root = 2 * np.sqrt(a * driver.deceleration)
    approach = v * driver.headway + v * (v - w) / root
    wanted = driver.standstill_gap + np.logaddexp(0.0, approach)
    gap = MIN_GAP + np.logaddexp(0.0, s - MIN_GAP)
    share = wanted / gap
    by_approach = 2 * a * share / gap * expit(approach)
    G = a + MAX_DECELERATION
    g = a * (v / driver.free_speed) ** 4 + a * share**2
    slope = -((1 + (g / G) ** 4) ** -1.25)
    above = (a - g / (1 + (g / G) ** 4) ** 0.25 + v / STOP_TIME) / _HALT  # the halt
    slope = slope * expit(above)
    by_speed = slope * (4 * a * v**3 / driver.free_speed**4 + by_approach * (driver.headway + (2 * v - w) / root))
    return Linearised(
        np.asarray(_HALT * np.logaddexp(0.0, above) - v / STOP_TIME),
        by_speed + (expit(above) - 1) / STOP_TIME,
        slope * (-2 * a * share**2 / gap * expit(s - MIN_GAP)),
        slope * by_approach * -v / root,
    )


def held(by_state: FloatArray, dt: float) -> FloatArray:
    """Change (..., 4, n) of positions and velocities by accelerations (..., 2, n) held over dt."""
    return np.concatenate([0.5 * dt * dt * by_state, dt * by_state], axis=-2)

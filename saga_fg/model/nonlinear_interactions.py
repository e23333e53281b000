"""Interaction functions that are not linear: accelerations by the states of two nodes.

    p' = p + dt v + dt^2 / 2 a,        v' = v + dt a,         a = sum_j rate_j tau a_j(x, x_j), held over the interval

    following   a = f(v . u, r - length, w . u) u          d = p_leader - p, r = |d|, u = d / |d|, w the leader's
                                                           velocity, f of the Intelligent Driver Model
    repulsion   a = A exp( (reach - r) / B ) u,            d from the neighbour, or the nearest point of a wall, to p

The second is the circular specification of the social force (Helbing, Farkas, Vicsek 2000, doi 10.1038/35035023,
equation 2 without body contact). The first is that of Treiber, Hennecke, Helbing (2000, doi
10.1103/PhysRevE.62.1805, equations 3 and 4) with round corners: at a corner a least-squares solution has no
linearisation, and solvers do not converge.

    f0 = a - g / (1 + (g / G)^4)^(1/4),    g = a (v / v_free)^4 + a (s* / s)^2,    G = a + max_deceleration
    s* = s0 + S(v T + v (v - w) / (2 sqrt(a b))),    S(x) = log(1 + e^x) for max(0, x), s likewise, m
    f  = -v / t_stop + h S((f0 + v / t_stop) / h)    for max(f0, -v / t_stop): vehicles do not reverse; h 0.05 m/s^2

Laws and their derivatives are continuous everywhere, or estimates do not settle where two walk into each other. Nearer
than w, r and u are the soft distance and its gradient (`factors.soft_distance`): the repulsion stays the downhill slope
of its potential A B exp( (reach - r) / B ), and at distance zero nothing acts. w is 0.3 m, of vehicles 1 m: estimates
come so near, centres of road users do not; bodies are 0.46 m deep (Fruin, Pedestrian Planning and Design, 1971).
Of a wall of pieces k, from c_k along the unit vector t_k for L_k, with tau = t_k . (p - c_k) and h = 0.05 m,

    d_k = p - c_k - t_k h ( S(tau / h) - S((tau - L_k) / h) )        for tau clipped to 0 ... L_k
    a   = sum_k w_k a(d_k),     w_k ~ exp(-r_k / h)                  for the nearest piece

An edge rule whose `interaction` is one of these makes `NonlinearEdges` of a scene graph: a filter linearises them at
the start of the interval, smoothers wherever their estimates are. `interaction` gives the same law for factors by hand.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, partial
from typing import ClassVar, NamedTuple, Protocol, runtime_checkable

import numpy as np
from scipy.special import expit, softmax

from factors import NonlinearInteraction
from factors.soft_distance import soft_distance
from saga_fg.model.intelligent_driver import LEAST_GAP, IntelligentDriver, Linearised
from saga_fg.model.interactions import POSITION, VELOCITY, Needs, NodeTable
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.settings import Positive, Settings, setting, settings_group

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


@runtime_checkable
class AccelerationLaw(Protocol):
    """Acceleration of a node with position and velocity by another; an edge of rate 1 / tau acts with all of it."""

    @property
    def time_constant(self) -> float:
        """tau, s."""

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
    driver: IntelligentDriver = settings_group(
        IntelligentDriver, "parameters of the driver; `hidden_vehicle_gap` is not used"
    )
    length: Positive = setting(
        4.5, "part of the distance between centres that vehicles fill where no boxes are known, m"
    )

    @property
    def time_constant(self) -> float:
        return self.driver.time_constant

    @property
    def alone(self) -> FloatArray:
        return np.array(self.length)

    def given(self, nodes: NodeTable, target: IntArray, source: IntArray) -> FloatArray:
        filled = (nodes.length[target] + nodes.length[source]) / 2
        return np.where(filled > 0, filled, self.length)

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
class SocialForce(Settings):
    """A pedestrian keeps away from another, or from a wall: from the nearest point of the source's outline."""

    needs: ClassVar[Needs] = (POSITION + VELOCITY, POSITION)
    strength: Positive = setting(2.0, "A: acceleration at the distance `reach`, m/s^2; higher: larger berth")
    falloff: Positive = setting(0.5, "B: distance over which the force falls to a third, m")
    reach: Positive = setting(0.6, "sum of the radii of both, m; for a wall, one radius")

    @property
    def time_constant(self) -> float:
        return 1.0

    @property
    def alone(self) -> FloatArray:
        return np.zeros((1, 4))

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
        force = self.strength * np.exp((self.reach - distance) / self.falloff)[..., None]
        pushes = force * away
        by_apart = force[..., None] * (soft.bend() - away[..., :, None] * away[..., None, :] / self.falloff)
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
    gap = LEAST_GAP + np.logaddexp(0.0, s - LEAST_GAP)
    share = wanted / gap
    by_approach = 2 * a * share / gap * expit(approach)
    G = a + driver.max_deceleration
    g = a * (v / driver.free_speed) ** 4 + a * share**2
    slope = -((1 + (g / G) ** 4) ** -1.25)
    above = (a - g / (1 + (g / G) ** 4) ** 0.25 + v / driver.stop_time) / _HALT  # the halt
    slope = slope * expit(above)
    by_speed = slope * (4 * a * v**3 / driver.free_speed**4 + by_approach * (driver.headway + (2 * v - w) / root))
    return Linearised(
        np.asarray(_HALT * np.logaddexp(0.0, above) - v / driver.stop_time),
        by_speed + (expit(above) - 1) / driver.stop_time,
        slope * (-2 * a * share**2 / gap * expit(s - LEAST_GAP)),
        slope * by_approach * -v / root,
    )


@cache
def interaction(law: AccelerationLaw) -> NonlinearInteraction:
    """The law for factors with keys (next, own, neighbours), states (p, v); stacks too."""
    return NonlinearInteraction(partial(_predict, law), partial(_jacobians, law), name=type(law).__name__)


def held(by_state: FloatArray, dt: float) -> FloatArray:
    """Change (..., 4, n) of positions and velocities by accelerations (..., 2, n) held over dt."""
    return np.concatenate([0.5 * dt * dt * by_state, dt * by_state], axis=-2)


def _predict(law: AccelerationLaw, x: FloatArray, others: list[FloatArray], dt: float) -> FloatArray:
    moved = x + dt * np.concatenate([x[..., 2:], np.zeros_like(x[..., 2:])], axis=-1)
    for other in others:
        moved = moved + held(law.accelerations(x, other, law.alone).value[..., None], dt)[..., 0]
    return moved


def _jacobians(
    law: AccelerationLaw, x: FloatArray, others: list[FloatArray], dt: float
) -> tuple[FloatArray, list[FloatArray]]:
    own = np.broadcast_to(np.eye(4) + dt * np.eye(4, k=2), (*x.shape, 4))
    by_others = []
    for other in others:
        _, by_own, by_other = law.accelerations(x, other, law.alone)
        own = own + held(by_own, dt)
        by_others.append(held(by_other, dt))
    return own, by_others

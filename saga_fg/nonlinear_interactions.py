"""Interaction functions that are not linear, for factors of the running graph: x' = f(x, neighbours, dt) + q.

Both move positions p and velocities v, states (p, v) in the plane, under an acceleration a held over the interval,

    p' = p + dt v + dt^2 / 2 a,        v' = v + dt a

    following   a = f(v . u, |d| - length, w . u) u        d = p_leader - p, u = d / |d|, w the leader's velocity,
                                                           f of the Intelligent Driver Model
    repulsion   a = sum_j A exp( (reach - |d_j|) / B ) d_j / |d_j|,      d_j = p - p_j

The second is the circular specification of the social force (Helbing, Farkas, Vicsek 2000, doi 10.1038/35035023,
equation 2 without body contact). The first is that of Treiber, Hennecke, Helbing (2000, doi
10.1103/PhysRevE.62.1805, equations 3 and 4) with round corners: a least-squares solution that lies on a corner has no
linearisation, and solvers go round it for ever.

    f  = a - g / (1 + (g / G)^4)^(1/4),    g = a (v / v_free)^4 + a (s* / s)^2,    G = a + hardest
    s* = s0 + S(v T + v (v - w) / (2 sqrt(a b))),    S(x) = log(1 + e^x) for max(0, x), s likewise, m

They take stacks, as `factors.NonlinearInteraction.factors` asks for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from factors import NonlinearInteraction
from saga_fg.arrays import FloatArray
from saga_fg.intelligent_driver import LEAST_GAP, IntelligentDriver, Linearised
from saga_fg.settings import require_positive, setting, settings_group

_NEAREST = 1e-3  # m; nearer, there is no direction


@dataclass(frozen=True)
class Following:
    """A vehicle with one neighbour, its leader, whom it follows as a driver does."""

    driver: IntelligentDriver = settings_group(IntelligentDriver, "the driver")
    length: float = setting(4.5, "of the gap that the vehicles fill themselves, between their centres, m")

    def __post_init__(self) -> None:
        require_positive(self, "length")

    @property
    def interaction(self) -> NonlinearInteraction:
        """For factors with keys (next, own, [leader])."""
        return NonlinearInteraction(self.predict, self.jacobians)

    def predict(self, x: FloatArray, others: list[FloatArray], dt: float) -> FloatArray:
        """States (..., 4) after dt seconds."""
        (leader,) = others
        distance, u = _direction(leader[..., :2] - x[..., :2])
        v, w = ((u * state[..., 2:]).sum(axis=-1) for state in (x, leader))
        f = self.acceleration(v, distance - self.length, w).value
        return _moved(x, f[..., None] * u, dt)

    def jacobians(self, x: FloatArray, others: list[FloatArray], dt: float) -> tuple[FloatArray, list[FloatArray]]:
        """Derivatives (..., 4, 4) by the own state and by the leader's."""
        (leader,) = others
        distance, u = _direction(leader[..., :2] - x[..., :2])
        v, w = ((u * state[..., 2:]).sum(axis=-1) for state in (x, leader))
        f = self.acceleration(v, distance - self.length, w)
        along = u[..., :, None] * u[..., None, :]
        turn = (np.eye(2) - along) / distance[..., None, None]  # du / dd
        by_turn = f.by_speed[..., None] * x[..., 2:] + f.by_leader[..., None] * leader[..., 2:]
        gradient = (turn @ by_turn[..., None])[..., 0] + f.by_gap[..., None] * u
        by_d = u[..., :, None] * gradient[..., None, :] + f.value[..., None, None] * turn
        own = _accelerated(-by_d, f.by_speed[..., None, None] * along, dt)
        own[..., :2, :2] += np.eye(2)
        own[..., :2, 2:] += dt * np.eye(2)
        own[..., 2:, 2:] += np.eye(2)
        return own, [_accelerated(by_d, f.by_leader[..., None, None] * along, dt)]

    def acceleration(self, v: FloatArray, s: FloatArray, w: FloatArray) -> Linearised:
        """f (...), m/s^2, at speeds v, gaps s, m, and leaders' speeds w, with its derivatives."""
        driver, a = self.driver, self.driver.acceleration
        root = 2 * np.sqrt(a * driver.deceleration)
        approach = v * driver.headway + v * (v - w) / root
        wanted = driver.standstill_gap + np.logaddexp(0.0, approach)
        gap = LEAST_GAP + np.logaddexp(0.0, s - LEAST_GAP)
        share = wanted / gap
        by_approach = 2 * a * share / gap * expit(approach)
        G = a + driver.hardest
        g = a * (v / driver.free_speed) ** 4 + a * share**2
        slope = -((1 + (g / G) ** 4) ** -1.25)
        return Linearised(
            np.asarray(a - g / (1 + (g / G) ** 4) ** 0.25),
            slope * (4 * a * v**3 / driver.free_speed**4 + by_approach * (driver.headway + (2 * v - w) / root)),
            slope * (-2 * a * share**2 / gap * expit(s - LEAST_GAP)),
            slope * by_approach * -v / root,
        )


@dataclass(frozen=True)
class SocialForce:
    """A pedestrian keeps away from all of its neighbours."""

    strength: float = setting(2.0, "A: acceleration at the distance `reach`, m/s^2")
    falloff: float = setting(0.5, "B: distance over which it falls to a third, m")
    reach: float = setting(0.6, "sum of two radii, m")

    def __post_init__(self) -> None:
        require_positive(self, "strength", "falloff", "reach")

    @property
    def interaction(self) -> NonlinearInteraction:
        """For factors with keys (next, own, neighbours)."""
        return NonlinearInteraction(self.predict, self.jacobians)

    def predict(self, x: FloatArray, others: list[FloatArray], dt: float) -> FloatArray:
        """States (..., 4) after dt seconds."""
        a = np.zeros_like(x[..., :2])
        for other in others:
            distance, away = _direction(x[..., :2] - other[..., :2])
            a = a + self.strength * np.exp((self.reach - distance) / self.falloff)[..., None] * away
        return _moved(x, a, dt)

    def jacobians(self, x: FloatArray, others: list[FloatArray], dt: float) -> tuple[FloatArray, list[FloatArray]]:
        """Derivatives (..., 4, 4) by the own state and by each neighbour's."""
        still, by_others = np.zeros((*x.shape[:-1], 2, 2)), []
        own = _accelerated(still, still, dt) + np.eye(4) + dt * np.eye(4, k=2)
        for other in others:
            distance, away = _direction(x[..., :2] - other[..., :2])
            force = self.strength * np.exp((self.reach - distance) / self.falloff)[..., None, None]
            along = away[..., :, None] * away[..., None, :]
            by_other = _accelerated(
                -force * ((np.eye(2) - along) / distance[..., None, None] - along / self.falloff), still, dt
            )
            own = own - by_other
            by_others.append(by_other)
        return own, by_others


def _direction(d: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Length (...) and direction (..., 2) of vectors (..., 2)."""
    length = np.maximum(np.hypot(d[..., 0], d[..., 1]), _NEAREST)
    return length, d / length[..., None]


def _moved(x: FloatArray, a: FloatArray, dt: float) -> FloatArray:
    p, v = x[..., :2], x[..., 2:]
    return np.concatenate([p + dt * v + 0.5 * dt * dt * a, v + dt * a], axis=-1)


def _accelerated(by_position: FloatArray, by_velocity: FloatArray, dt: float) -> FloatArray:
    """What derivatives (..., 2, 2) of an acceleration make of the next state, (..., 4, 4)."""
    by_state = np.concatenate([by_position, by_velocity], axis=-1)
    return np.concatenate([0.5 * dt * dt * by_state, dt * by_state], axis=-2)

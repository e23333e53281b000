"""The Intelligent Driver Model of car following (Treiber, Hennecke, Helbing 2000, doi 10.1103/PhysRevE.62.1805).

    dv/dt = a [ 1 - (v / v0)^4 - (s*(v, dv) / s)^2 ],     s*(v, dv) = s0 + max(0, v T + v dv / (2 sqrt(a b)))

with v the speed, s the gap to the leader, bumper to bumper, and dv = v - v_leader the approach rate (equations 3 and
4 there). A driver faster than his desired speed, which happens when the speed limit drops, brakes with b at most
for that reason. In equilibrium (dv/dt = 0, dv = 0) the gap is s_e(v) = (s0 + v T) / sqrt(1 - (v / v0)^4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.columns import Columns

HARDEST_BRAKING = 9.0  # m/s^2, what tyres on a dry road can do


@dataclass(frozen=True, eq=False)
class Drivers(Columns):
    """The parameters of N drivers, each of shape (N,), or broadcastable."""

    desired_speed: FloatArray  # v0, m/s
    time_headway: FloatArray  # T, s
    minimum_gap: FloatArray  # s0, m
    max_acceleration: FloatArray  # a, m/s^2
    comfortable_deceleration: FloatArray  # b, m/s^2


def free_acceleration(speed: FloatArray, drivers: Drivers, speed_limit: FloatArray | float = np.inf) -> FloatArray:
    """Acceleration (N,), m/s^2, on an empty road, where nobody wants to be faster than `speed_limit`."""
    desired = np.minimum(drivers.desired_speed, speed_limit)
    wish = drivers.max_acceleration * (1 - (speed / desired) ** 4)
    return np.asarray(np.maximum(wish, -drivers.comfortable_deceleration))


def following_acceleration(
    speed: FloatArray, gap: FloatArray, leader_speed: FloatArray, drivers: Drivers
) -> FloatArray:
    """The interaction term -a (s*/s)^2 (N,), m/s^2: 0 for an infinite gap, never below what brakes can do."""
    root = 2 * np.sqrt(drivers.max_acceleration * drivers.comfortable_deceleration)
    desired_gap = drivers.minimum_gap + np.maximum(
        0.0, speed * drivers.time_headway + speed * (speed - leader_speed) / root
    )
    term = drivers.max_acceleration * (desired_gap / np.maximum(gap, 0.01)) ** 2
    return np.asarray(-np.minimum(term, HARDEST_BRAKING))


def equilibrium_gap(speed: FloatArray | float, drivers: Drivers) -> FloatArray:
    """Gap s_e(v) (N,), m, at which drivers follow a leader of constant `speed` below their desired speed."""
    ratio = np.asarray(speed, dtype=np.float64) / drivers.desired_speed
    return np.asarray((drivers.minimum_gap + speed * drivers.time_headway) / np.sqrt(1 - ratio**4))

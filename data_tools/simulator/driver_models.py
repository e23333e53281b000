"""Driver models of car following and lane changes: the Intelligent Driver Model (IDM) and MOBIL.

IDM (Treiber, Hennecke, Helbing 2000, doi 10.1103/PhysRevE.62.1805, equations 3 and 4):

    dv/dt = a [ 1 - (v / v0)^4 - (s*(v, dv) / s)^2 ],     s*(v, dv) = s0 + max(0, v T + v dv / (2 sqrt(a b)))

with v the speed, s the gap to the leader, bumper to bumper, and dv = v - v_leader the approach rate. A driver faster
than his desired speed, which happens when the speed limit drops, brakes with b at most for that reason. In equilibrium
(dv/dt = 0, dv = 0) the gap is s_e(v) = (s0 + v T) / sqrt(1 - (v / v0)^4).

MOBIL (Kesting, Treiber, Helbing 2007, doi 10.3141/1999-10): with a the present acceleration of a driver, a' that behind
his new leader, and o, o' those of his new follower without and with him, he changes lanes if

    o' > -b_safe  and  a' > -b_safe                    nobody has to brake hard (gap acceptance)
    a' - a + p (o' - o) > threshold                    the gain is large enough

In a lane that ends the second condition is waived. Gaps of at least s0 / 2 are required on both sides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_tools.simulator.lanes import LaneOrder
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.columns import Columns

HARDEST_BRAKING = 9.0  # m/s^2, limit of tyres on a dry road
POLITENESS = 0.3  # p of MOBIL (Kesting, Treiber and Helbing 2007): weight of the new follower's loss
CHANGE_THRESHOLD = 0.3  # a_th of MOBIL, m/s^2: least gain for which a driver changes lanes
SAFE_DECELERATION = 3.0  # b_safe of MOBIL, m/s^2: largest deceleration a lane change may cause


@dataclass(frozen=True, eq=False)
class Drivers(Columns):
    """The parameters of N drivers, each of shape (N,), or broadcastable."""

    desired_speed: FloatArray  # v0, m/s
    time_headway: FloatArray  # T, s
    minimum_gap: FloatArray  # s0, m
    max_acceleration: FloatArray  # a, m/s^2
    comfortable_deceleration: FloatArray  # b, m/s^2


def free_acceleration(speed: FloatArray, drivers: Drivers, speed_limit: FloatArray | float = np.inf) -> FloatArray:
    """Acceleration (N,), m/s^2, on an empty road with a speed limit, m/s."""
    desired = np.minimum(drivers.desired_speed, speed_limit)
    acceleration = drivers.max_acceleration * (1 - (speed / desired) ** 4)
    return np.asarray(np.maximum(acceleration, -drivers.comfortable_deceleration))


def following_acceleration(
    speed: FloatArray, gap: FloatArray, leader_speed: FloatArray, drivers: Drivers
) -> FloatArray:
    """Interaction term -a (s*/s)^2 (N,), m/s^2: 0 for an infinite gap, bounded by `HARDEST_BRAKING`."""
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


def lane_change_gain(
    drivers: Drivers,
    length: FloatArray,
    s: FloatArray,
    speed: FloatArray,
    acceleration: FloatArray,
    target: IntArray,
    must: BoolArray,
    order: LaneOrder,
) -> FloatArray:
    """Gain (N,), m/s^2, of each driver in lane `target` (N,; -1: none); -inf where the change is not allowed.

    length and s m, speed m/s and acceleration m/s^2 (N,): the present state; must (N,): the present lane ends.
    """
    leader, follower = order.ahead(target, s), order.behind(target, s)
    half = length / 2
    front = np.where(leader >= 0, s[leader] - s - half[leader] - half, np.inf)
    rear = np.where(follower >= 0, s - s[follower] - half[follower] - half, np.inf)
    mine = free_acceleration(speed, drivers) + following_acceleration(speed, front, speed[leader], drivers)
    others = drivers.select(follower)
    theirs = free_acceleration(speed[follower], others) + following_acceleration(speed[follower], rear, speed, others)
    loss = np.where(follower >= 0, np.maximum(acceleration[follower] - theirs, 0.0), 0.0)
    safe = (mine > -SAFE_DECELERATION) & ((theirs > -SAFE_DECELERATION) | (follower < 0))
    room = (front > drivers.minimum_gap / 2) & (rear > drivers.minimum_gap / 2)
    gain = mine - acceleration - POLITENESS * loss
    worth = must | (gain > CHANGE_THRESHOLD)
    return np.where((target >= 0) & safe & room & worth, gain + np.where(must, 100.0, 0.0), -np.inf)


def best_lane_changes(gain: FloatArray, target: IntArray) -> IntArray:
    """Rows (C,) of the drivers who change now: for each target lane (N,) the one with the largest finite gain (N,)."""
    candidates = np.flatnonzero(np.isfinite(gain))
    best = candidates[np.argsort(-gain[candidates], kind="stable")]
    _, first = np.unique(target[best], return_index=True)
    return best[np.sort(first)]

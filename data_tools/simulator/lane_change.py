"""When drivers change lanes: the rule MOBIL (Kesting, Treiber, Helbing 2007, doi 10.3141/1999-10).

With a the present acceleration of a driver, a' that behind his new leader, and o, o' those of his new follower without
and with him, he changes if

    o' > -b_safe  and  a' > -b_safe                    nobody has to brake hard (gap acceptance)
    a' - a + p (o' - o) > threshold                    it is worth it

and in a lane that ends the second condition is waived. To these come gaps of at least s0 / 2 on both sides.
"""

from __future__ import annotations

import numpy as np

from data_tools.simulator.fleet import Fleet
from data_tools.simulator.idm import following_acceleration, free_acceleration
from data_tools.simulator.neighbours import LaneOrder
from data_tools.simulator.settings import DriverSettings
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray


def advantage(
    fleet: Fleet,
    s: FloatArray,
    speed: FloatArray,
    acceleration: FloatArray,
    target: IntArray,
    must: BoolArray,
    order: LaneOrder,
    settings: DriverSettings,
) -> FloatArray:
    """How much every driver (N,) gains, m/s^2, by moving to lane `target` (N,; -1: none); -inf where he may not.

    s m, speed m/s and acceleration m/s^2 (N,): the present state; `must` (N,): the own lane ends.
    """
    drivers = fleet.drivers
    leader, follower = order.ahead(target, s), order.behind(target, s)
    half = fleet.length / 2
    front = np.where(leader >= 0, s[leader] - s - half[leader] - half, np.inf)
    rear = np.where(follower >= 0, s - s[follower] - half[follower] - half, np.inf)
    mine = free_acceleration(speed, drivers) + following_acceleration(speed, front, speed[leader], drivers)
    others = drivers.select(follower)
    theirs = free_acceleration(speed[follower], others) + following_acceleration(speed[follower], rear, speed, others)
    loss = np.where(follower >= 0, np.maximum(acceleration[follower] - theirs, 0.0), 0.0)
    safe = (mine > -settings.safe_deceleration) & ((theirs > -settings.safe_deceleration) | (follower < 0))
    room = (front > drivers.minimum_gap / 2) & (rear > drivers.minimum_gap / 2)
    gain = mine - acceleration - settings.politeness * loss
    worth = must | (gain > settings.change_threshold)
    return np.where((target >= 0) & safe & room & worth, gain + np.where(must, 100.0, 0.0), -np.inf)


def choose(gain: FloatArray, target: IntArray) -> IntArray:
    """The drivers who change now: for each target lane (N,) the one with the largest finite gain (N,), rows (C,)."""
    willing = np.flatnonzero(np.isfinite(gain))
    best = willing[np.argsort(-gain[willing], kind="stable")]
    _, first = np.unique(target[best], return_index=True)
    return best[np.sort(first)]

"""Vehicles of the simulator and the models of their drivers.

Driver models of car following and lane changes: the Intelligent Driver Model (IDM) and MOBIL.

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

from dataclasses import dataclass, replace

import numpy as np

from data_tools.simulator.road import LaneOrder
from data_tools.simulator.settings import VAN_SHARE, TrafficSettings
from saga_fg.numerics.arrays import BoolArray, Columns, FloatArray, IntArray, StrArray

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


TIME_HEADWAY = 1.2  # T of the IDM (Treiber, Hennecke and Helbing 2000), s: desired time headway
MINIMUM_GAP = 2.0  # s0 of the IDM, m: gap kept at standstill
MAX_ACCELERATION = 1.5  # a of the IDM, m/s^2: maximum acceleration
COMFORTABLE_DECELERATION = 2.0  # b of the IDM, m/s^2: comfortable deceleration
DRIVER_SPREAD = 0.15  # relative standard deviation of the parameters over drivers (log-normal)


@dataclass(frozen=True)
class Kind:
    """Kind of vehicle: class label, mean and deviation of its size, m, and driver parameters relative to a car."""

    name: str
    label: str
    size: tuple[float, float, float]
    spread: tuple[float, float, float]
    speed: float = 1.0
    headway: float = 1.0
    acceleration: float = 1.0


KINDS = (
    Kind("car", "car", (4.6, 1.85, 1.58), (0.3, 0.07, 0.1)),
    Kind("van", "car", (5.3, 2.0, 2.15), (0.4, 0.06, 0.2)),
    Kind("truck", "truck", (8.5, 2.45, 3.3), (1.4, 0.1, 0.3), speed=0.9, headway=1.2, acceleration=0.65),
    Kind("bus", "bus", (11.8, 2.5, 3.1), (0.7, 0.05, 0.15), speed=0.9, headway=1.15, acceleration=0.7),
)
CAR, VAN, TRUCK, BUS = range(4)
HITCH = 0.9  # m between truck and trailer
TRAILER_LENGTH = (6.0, 11.0)  # m


@dataclass(frozen=True, eq=False)
class Fleet(Columns):
    """N vehicles: kind (N,) rows of `KINDS`, size (N, 3) m, and drivers of shape (N,)."""

    kind: IntArray
    size: FloatArray
    drivers: Drivers

    @property
    def label(self) -> StrArray:
        return np.array([kind.label for kind in KINDS])[self.kind]

    @property
    def length(self) -> FloatArray:
        return self.size[:, 0]


def sample_sizes(kind: IntArray, rng: np.random.Generator) -> FloatArray:
    """Random sizes (N, 3), m, of vehicles of the given kinds, within two deviations of the mean."""
    mean = np.array([k.size for k in KINDS])[kind]
    spread = np.array([k.spread for k in KINDS])[kind]
    return np.asarray(mean + spread * np.clip(rng.standard_normal(mean.shape), -2, 2))


def sample_kinds(count: int, settings: TrafficSettings, rng: np.random.Generator) -> IntArray:
    """Random kinds (count,) of moving vehicles."""
    shares = np.array([VAN_SHARE, settings.truck_share, settings.bus_share])
    return rng.choice(len(KINDS), size=count, p=[1 - shares.sum(), *shares])


def sample_fleet(count: int, desired_speed: float, traffic: TrafficSettings, rng: np.random.Generator) -> Fleet:
    """`count` random vehicles; `desired_speed`, m/s, is the mean over the drivers of cars."""
    kind = sample_kinds(count, traffic, rng)

    def spread(mean: float, factor: FloatArray | float = 1.0) -> FloatArray:
        deviation = np.clip(rng.standard_normal(count), -2.5, 2.5)
        return np.asarray(mean * factor * np.exp(DRIVER_SPREAD * deviation))

    speed, headway, acceleration = (
        np.array([getattr(k, name) for k in KINDS])[kind] for name in ("speed", "headway", "acceleration")
    )
    return Fleet(
        kind,
        sample_sizes(kind, rng),
        Drivers(
            spread(desired_speed, speed),
            spread(TIME_HEADWAY, headway),
            spread(MINIMUM_GAP),
            spread(MAX_ACCELERATION, acceleration),
            spread(COMFORTABLE_DECELERATION),
        ),
    )


def attach_trailers(fleet: Fleet, share: float, rng: np.random.Generator) -> tuple[Fleet, FloatArray]:
    """Attach trailers to a share of the trucks: the fleet with total lengths, and lengths (N,) of trailers, m, or 0."""
    trailer = np.zeros(len(fleet))
    if share > 0:
        tows = (fleet.kind == TRUCK) & (rng.random(len(fleet)) < share)
        trailer = np.where(tows, rng.uniform(*TRAILER_LENGTH, len(fleet)), 0.0)
    size = fleet.size.copy()
    size[:, 0] += np.where(trailer > 0, trailer + HITCH, 0.0)
    return replace(fleet, size=size), trailer

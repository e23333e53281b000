"""Crossings without signals, simulated: who has the right of way, who waits for it, and who goes.

    priority    vehicles of the minor road wait at their line until those of the major road leave a gap
    all-way     all wait at their lines, and go in the order in which they came there

Four approaches of one lane each meet at right angles; vehicles go straight on, or turn right. They follow the nearest
vehicle ahead on their way, and a closed line as one that stands there, by the intelligent driver model (Treiber,
Hennecke and Helbing, Physical Review E 62, 2000). Drivers differ in speed, headway, acceleration and in the gap that
they accept, 4 to 6.5 s (Highway Capacity Manual 2010, exhibit 19-10: 4.1 to 7.1 s).
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from typing import Literal

import numpy as np

from benchmarks.recordings.traffic import PERIOD, RecordedTraffic, Recordings, on_grid
from saga_fg.numerics import FloatArray

Rule = Literal["priority", "all-way"]
RULES: tuple[Rule, ...] = ("priority", "all-way")
DURATION, WARM_UP = 40.0, 25.0  # s of a recording, and before it
APPROACH, LANE = 120.0, 3.5  # m from the start of a way to the middle; m
LINE = APPROACH - 9.0  # m along a way, of its stop line
CLEAR = APPROACH + 9.0  # m, from which on a vehicle has left the crossing
FLOW = {"priority": (0.16, 0.10), "all-way": (0.10, 0.10)}  # vehicles a second and way, of the major and minor road
TURNING = 0.25  # share of vehicles that turn right
RADIUS = 7.0  # m, of right turns
LENGTH, WIDTH = 4.6, 1.8  # m
JAM, BRAKING = 2.0, 2.0  # m between standing vehicles; m/s^2, comfortable
STOPPED = 3.0  # m before the line, where a vehicle has come to it
BESIDE = 1.6  # m, within which a vehicle is on the way of another


@dataclass
class Driver:
    """A vehicle on a way: its number, the way's direction 0 to 3 (0 and 2 are the major road), s, m; v, m/s.

    accepted  gap, s;  arrived: time at the line, s;  goes: may cross the line
    """

    number: int
    direction: int
    turns: bool
    wanted: float
    headway: float
    acceleration: float
    accepted: float
    s: float = 0.0
    v: float = 0.0
    arrived: float = math.inf
    goes: bool = False

    def place(self, ahead: float = 0.0) -> tuple[FloatArray, float]:
        """Position (2,) and heading, rad, at some way ahead."""
        return _along(self.direction, self.turns, self.s + ahead)


def simulated_crossings(scenes: int, seed: int = 0) -> Recordings:
    """Recordings of crossings, half of each rule."""
    names = tuple(f"{RULES[k % 2]}-{k // 2}" for k in range(scenes))
    return Recordings(names, lambda name: _recorded(name, seed))


def _recorded(name: str, seed: int) -> RecordedTraffic:
    rule = next(each for each in RULES if name.startswith(each))
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    rows: list[tuple[int, Driver, FloatArray, float, float]] = []
    drivers: list[Driver] = []
    number, steps = 0, round(WARM_UP / PERIOD)
    for k in range(steps + round(DURATION / PERIOD) + 1):
        for direction in range(4):
            new = rng.random() < FLOW[rule][direction % 2] * PERIOD
            behind = min((one.s for one in drivers if one.direction == direction), default=math.inf)
            if new and behind > 25.0:
                drivers.append(_new_driver(rng, number, direction))
                number += 1
        _let_go(rule, drivers, k * PERIOD)
        acceleration = [_acceleration(one, drivers) for one in drivers]
        for one, a in zip(drivers, acceleration, strict=True):
            one.s += max(0.0, one.v * PERIOD + a * PERIOD**2 / 2) if one.v + a * PERIOD > 0 else 0.0
            one.v = max(0.0, one.v + a * PERIOD)
        drivers = [one for one in drivers if one.s < 2 * APPROACH]
        if k >= steps:
            rows += [(k - steps, one, *one.place(), one.v) for one in drivers]
    moment = np.array([row[0] for row in rows])
    names = np.array([f"{row[1].number}" for row in rows])
    position, yaw, speed = (np.array([row[c] for row in rows]) for c in (2, 3, 4))
    velocity = speed[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)])
    sizes = dict.fromkeys(names.tolist(), ("car", LENGTH, WIDTH))
    return on_grid(name, moment, names, (position, velocity, yaw), sizes)


def _new_driver(rng: np.random.Generator, number: int, direction: int) -> Driver:
    wanted = rng.uniform(10.0, 15.0)
    own = rng.uniform(0.9, 1.6), rng.uniform(1.2, 2.2), rng.uniform(4.0, 6.5)
    return Driver(number, direction, bool(rng.random() < TURNING), wanted, *own, v=0.9 * wanted)


def _along(direction: int, turns: bool, s: float) -> tuple[FloatArray, float]:
    """Position (2,) and heading of a way at s: from -x along y = -LANE / 2, turned by the direction."""
    x, y, heading = s - APPROACH, -LANE / 2, 0.0
    begin = -LANE / 2 - RADIUS  # of the turn to the right, into the way of the next direction
    if turns and x > begin:
        angle = min((x - begin) / RADIUS, math.pi / 2)
        on = x - begin - angle * RADIUS
        x, y = begin + RADIUS * math.sin(angle), y - RADIUS * (1 - math.cos(angle)) - on
        heading = -angle
    turn = direction * math.pi / 2
    c, sn = math.cos(turn), math.sin(turn)
    return np.array([c * x - sn * y, sn * x + c * y]), heading + turn


def _leader(one: Driver, drivers: list[Driver]) -> tuple[float, float] | None:
    """Distance between bumpers, m, and speed, m/s, of the nearest vehicle ahead on one's way."""
    best = None
    ahead = np.arange(2.0, 60.0, 2.0)
    places = [one.place(float(d)) for d in ahead]
    line, headings = np.array([place for place, _ in places]), np.array([heading for _, heading in places])
    for other in drivers:
        if other is one:
            continue
        place, heading = other.place()
        apart = np.hypot(*(line - place).T)
        k = int(np.argmin(apart))
        if apart[k] < BESIDE and math.cos(heading - headings[k]) > 0.7 and (best is None or ahead[k] < best[0]):
            best = float(ahead[k]), other.v * math.cos(heading - headings[k])
    return None if best is None else (max(best[0] - LENGTH, 0.1), best[1])


def _acceleration(one: Driver, drivers: list[Driver]) -> float:
    """By the intelligent driver model, behind a leader, a closed line and into a turn."""
    wanted = min(one.wanted, 5.0) if one.turns and LINE - 15 < one.s < CLEAR else one.wanted
    free = 1 - (one.v / wanted) ** 4
    found = [leader for leader in (_leader(one, drivers),) if leader is not None]
    if not one.goes and one.s < LINE:
        found.append((max(LINE - one.s + JAM - 0.5, 0.1), 0.0))
    pull = 0.0
    for gap, speed in found:
        wish = JAM + max(
            0.0, one.v * one.headway + one.v * (one.v - speed) / (2 * math.sqrt(one.acceleration * BRAKING))
        )
        pull = max(pull, (wish / gap) ** 2)
    return max(one.acceleration * (free - pull), -8.0)


def _let_go(rule: Rule, drivers: list[Driver], time: float) -> None:
    """Decide who may cross their lines now."""
    inside = [one for one in drivers if one.goes and LINE - STOPPED < one.s < CLEAR]
    for one in drivers:
        if rule == "priority" and one.direction % 2 == 0:
            one.goes = True
        elif one.s > LINE - STOPPED and one.v < 1.0:
            one.arrived = min(one.arrived, time)
    waiting = sorted((one for one in drivers if not one.goes and one.arrived < math.inf), key=lambda one: one.arrived)
    for one in waiting:
        if rule == "all-way":
            free = all(other.direction == one.direction for other in inside)
        else:
            major = [other for other in drivers if other.direction % 2 == 0 and other.s < CLEAR]
            free = all((LINE - other.s) / max(other.v, 1.0) > one.accepted for other in major)
            free = free and all(other.direction % 2 == 1 for other in inside)
        if free and time - one.arrived > 0.5:
            one.goes = True
            inside.append(one)

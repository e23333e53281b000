"""Right of way: who waits for whom where paths cross or come together, and who goes though it should wait.

Vehicles in view go on along their paths (`saga_fg.tracking.prediction`), which follow the trails of earlier traffic and
the lanes of the map. Two meet where a point of one path is within `NEAR` m of the other path, at its first such point,
unless one is behind the other there or they pass head on. A vehicle waits at the place where earlier traffic halted
before that point (`saga_fg.tracking.edge_record`), else `CROSSING` or `JOINING` m before it, and has arrived
`ARRIVES` m before this line.

People who walk go straight on, and stand `STANDS` m before the middle of the way of vehicles; who waits for whom of a
person and a vehicle is told alike, by weights of its own.

For each ordered pair i, j the evidence e (`_evidence`) holds distances, speeds, times, who leads, where traffic halts
and the order of arrival. One model tells two relations, as both rest on who should go first, and who does: i yields to
j; or i takes the right of way of j, where i should wait and goes, and j brakes or would have to. Their probabilities:

    p = 1 / ( 1 + exp(-z) ),   z = W tanh(V [e, 1]) + w_0

smoothed over `SMOOTHING` s. V, W are fitted to simulated crossings and merges of known rules, by
`python -m benchmarks right-of-way --fit`.

Vehicles that are not detected are judged by where they are predicted. Such a vehicle waits with the probability P, the
largest of those with which it yields, or halts at a stop sign until `STAYS` s after its arrival. Its acceleration along
its path is the mean of both, d m before its line and a where it goes on:

    a' = (1 - P) a - P min( v^2 / (2 d), `HARDEST` )
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from scipy.special import expit

from saga_fg.kernels.paths import path_meetings
from saga_fg.model import NodeTable, Paths, ahead_and_aside, unit
from saga_fg.numerics import BoolArray, FloatArray, IntArray
from saga_fg.tracking.edge_record import Lines
from saga_fg.tracking.right_of_way_weights import HIDDEN, OUT, PEOPLE, WALKING
from saga_fg.tracking.traffic import STEP as PATH_STEP
from saga_fg.types import RELATIONS, Relations

INTERVAL = 0.2  # s between two judgements
LEAST = (0.7, 0.5)  # probability from which each of `RELATIONS` is told
SMOOTHING = 0.3  # s, of probabilities
SPEED_SMOOTHING = 0.5  # s, of changes of speed
SPACING, BEHIND = 1.0, 5  # m between points of a path, and how many of them are behind the vehicle's middle
NEAR = 1.5  # m between paths that meet
ALIKE, HEAD_ON = 0.8, -0.9  # cosine between courses that come together, and of those that pass head on
LOOKS, AHEAD, FARTHEST = 25.0, 5.0, 60.0  # m, and s, for which paths are followed, to so many m
WALKED = 8.0  # m, likewise, of those of people
CROSSING, JOINING = 5.0, 20.0  # m before a meeting point, where vehicles wait at unknown lines
STANDS = 2.5  # m, likewise, of people
ARRIVES, SOON = 4.0, 0.5  # m before the line; s, in which a vehicle arrives at the earliest that has not
STAYS = 3.0  # s from there until a vehicle that halts for nobody goes on
AT_LINE, PASSED, HARDEST = 0.3, 1.0, 4.0  # m before and beyond a line, where vehicles stand and have left; m/s^2
GOES, CRUISE, SLOW = 1.8, 10.0, 2.0  # m/s^2 and m/s of a vehicle that goes on freely; m/s
LINGERS = 1.0  # m/s, as `SLOW`, of people

Pair = tuple[int, int]
PERSON = "pedestrian"
YIELDS, TAKES = 0, 1  # among `RELATIONS`
JOINS = 22  # column of evidence: 1 where the ways come together, 0 where they cross
WALKS = 26  # 1 where the first one is a person, -1 where the second one is, 0 where none is


class Meetings(NamedTuple):
    """E ordered pairs of vehicles whose paths meet: rows (E, 2); distance (E, 2), m, from the middle of each to
    the point; cosine (E,) between their courses there."""

    rows: IntArray
    distance: FloatArray
    cosine: FloatArray


@dataclass(frozen=True, eq=False)
class RightOfWay:
    """Right of way between vehicles, and what is remembered of them.

    time         of the latest judgement, s
    motion       speed, m/s, and acceleration, m/s^2, of vehicles, by id
    arrived      when they have arrived, s, by id
    probability  of each of `RELATIONS` from the first to the second, by ids
    line         place (2,), local, m, at which the first would wait for the second, by ids of those whose paths cross
    halts        probability that vehicles halt at a line for nobody, and its place (2,), by id
    """

    time: float = -math.inf
    motion: Mapping[int, tuple[float, float]] = field(default_factory=dict)
    arrived: Mapping[int, float] = field(default_factory=dict)
    probability: Mapping[Pair, tuple[float, ...]] = field(default_factory=dict)
    line: Mapping[Pair, FloatArray] = field(default_factory=dict)
    halts: Mapping[int, tuple[float, FloatArray]] = field(default_factory=dict)

    def due(self, time: float) -> bool:
        """True if it is time for another judgement."""
        return time - self.time >= INTERVAL - 1e-6

    def without(self, nodes: set[int]) -> Self:
        """Without what is known of some vehicles."""
        motion = {node: one for node, one in self.motion.items() if node not in nodes}
        arrived = {node: then for node, then in self.arrived.items() if node not in nodes}
        probability = {pair: p for pair, p in self.probability.items() if nodes.isdisjoint(pair)}
        line = {pair: place for pair, place in self.line.items() if nodes.isdisjoint(pair)}
        halts = {node: one for node, one in self.halts.items() if node not in nodes}
        return replace(self, motion=motion, arrived=arrived, probability=probability, line=line, halts=halts)

    @cached_property
    def _waiting(self) -> dict[int, tuple[float, FloatArray]]:
        """Vehicles that may wait, by id: the probability, and the place (2,) of the line."""
        found = dict(self.halts)
        for pair, place in self.line.items():
            if (p := self.probability.get(pair, (0.0,))[YIELDS]) > found.get(pair[0], (0.0,))[0]:
                found[pair[0]] = p, place
        return found

    def waiting(self, ids: IntArray) -> FloatArray:
        """Probability (n,) that vehicles wait, by `ids` (n,)."""
        return np.array([self._waiting[node][0] if node in self._waiting else 0.0 for node in ids.tolist()])

    def decided(self, waits: bool) -> Self:
        """As if all that may wait did, or nobody."""
        return replace(self, line={}, halts={node: (1.0, at) for node, (_, at) in self._waiting.items() if waits})

    def accelerations(
        self, ids: IntArray, position: FloatArray, heading: FloatArray, velocity: FloatArray, free: FloatArray
    ) -> FloatArray:
        """Expected accelerations (k,) of vehicles along their paths, m/s^2; `free` (k,): of those that do not wait.

        Who waits brakes to a stop at the line; one whose velocity points back, as noise makes it, does not.
        """
        rows = np.flatnonzero([node in self._waiting for node in ids.tolist()])
        known = [self._waiting[node] for node in ids[rows].tolist()]
        share, places = np.array([p for p, _ in known]), np.array([place for _, place in known]).reshape(-1, 2)
        ahead = unit(heading[rows])
        speed = np.maximum(np.einsum("ni,ni->n", velocity[rows], ahead), 0.0)
        left, _ = ahead_and_aside(places - position[rows], ahead)
        braking = np.where(left > -PASSED, speed**2 / (2 * np.maximum(left, AT_LINE)), 0.0)
        found = free.copy()
        found[rows] = (1 - share) * free[rows] - share * np.minimum(braking, HARDEST)
        return found

    def relations(self, ids: IntArray) -> Relations:
        """Relations between the tracks `ids` (n,) that are probable enough to be told."""
        told = [
            (*pair, name, p)
            for pair, each in self.probability.items()
            for name, p, least in zip(RELATIONS, each, LEAST, strict=True)
            if p >= least
        ]
        return Relations.of_rows(told).between(ids)

    def later(self, nodes: NodeTable, paths: Paths, lines: Lines, time: float) -> Self:
        """After a judgement of the vehicles that have `paths`; see `observed`."""
        known, pairs, found = self.observed(nodes, paths, lines, time)
        kept = math.exp((self.time - time) / SMOOTHING)
        now = dict(zip(pairs, map(tuple, probabilities(found).tolist()), strict=True))
        smoothed = {
            pair: tuple(kept * a + (1 - kept) * p for a, p in zip(self.probability.get(pair, each), each, strict=True))
            for pair, each in now.items()
        }
        return replace(known, probability=smoothed)

    def observed(
        self, nodes: NodeTable, paths: Paths, lines: Lines, time: float
    ) -> tuple[Self, list[Pair], FloatArray]:
        """Return the new memory at a `time`, s, the pairs of ids of vehicles that meet, and their evidence (E, F).

        lines  where earlier traffic halted
        """
        rows, heading = paths.row, nodes.heading[paths.row]
        ids, half = nodes.id[rows].tolist(), nodes.length[rows] / 2
        speed = np.maximum(np.einsum("ni,ni->n", nodes.velocity[rows], unit(heading)), 0.0)
        motion = self._motion(ids, speed.tolist(), time)
        walks = nodes.label[rows] == PERSON
        slow = np.where(walks, LINGERS, SLOW)
        meetings, lead = _meetings(paths, nodes.position[rows], heading, speed, walks)
        to_line, halts, alone = lines.next_of(nodes.position[rows], heading)
        usual = np.full(len(rows), np.inf)
        usually = np.where(walks[meetings.rows], STANDS, np.where(meetings.cosine > ALIKE, JOINING, CROSSING)[:, None])
        before = meetings.distance - half[meetings.rows] - usually
        np.minimum.at(usual, meetings.rows, before)
        to_line = np.where(np.isfinite(to_line), to_line, usual)
        near = {node: d for node, d in zip(ids, to_line.tolist(), strict=True) if d <= LOOKS}
        arrived = {
            node: self.arrived.get(node, time) for node, d in near.items() if d < ARRIVES or node in self.arrived
        }
        comes = time + np.maximum((to_line - ARRIVES) / np.maximum(speed, slow), SOON)
        arrival = np.minimum(comes, [arrived.get(node, math.inf) for node in ids])
        acceleration = np.array([motion[node][1] for node in ids])
        columns = np.column_stack([half, speed, acceleration, to_line, halts, lead, arrival, walks])
        pairs = [(ids[i], ids[j]) for i, j in meetings.rows.tolist()]
        crossing = np.flatnonzero(meetings.cosine <= ALIKE)  # those who come together do not halt
        place = nodes.position[rows] + np.minimum(to_line, FARTHEST)[:, None] * unit(heading)
        line = {pairs[k]: place[meetings.rows[k, 0]] for k in crossing.tolist()}
        stays = np.array([arrived.get(node, time) > time - STAYS for node in ids], dtype=np.bool_)
        stops = np.flatnonzero((alone > 0) & (to_line < LOOKS) & stays)
        halting = {ids[k]: (float(alone[k]), place[k]) for k in stops.tolist()}
        return type(self)(time, motion, arrived, line=line, halts=halting), pairs, _evidence(meetings, columns)

    def _motion(self, ids: list[int], speed: list[float], time: float) -> dict[int, tuple[float, float]]:
        """Speed and smoothed acceleration of vehicles, by id."""
        dt, kept = time - self.time, math.exp((self.time - time) / SPEED_SMOOTHING)
        known = {node: self.motion[node] for node in ids if node in self.motion}
        changes = ((v - known[node][0]) / dt if node in known else 0.0 for node, v in zip(ids, speed, strict=True))
        return {
            node: (v, kept * known.get(node, (v, 0.0))[1] + (1 - kept) * a)
            for node, v, a in zip(ids, speed, changes, strict=True)
        }


def probabilities(evidence: FloatArray) -> FloatArray:
    """The probability (E, 2) of each of `RELATIONS` from the first of each pair to the second, by evidence (E, F)."""
    found, person = np.zeros((len(evidence), 2)), evidence[:, WALKS] != 0
    for rows, hidden, out in ((~person, HIDDEN, OUT), (person, WALKING, PEOPLE)):
        found[rows] = expit(np.tanh(evidence[rows] @ hidden[:-1] + hidden[-1]) @ out[:-1] + out[-1])
    found[:, TAKES] = np.where(evidence[:, JOINS] > 0, found[:, TAKES], 0.0)
    return np.asarray(found)


def free_time(distance: FloatArray, speed: FloatArray) -> FloatArray:
    """Time, s, in which vehicles of a speed, m/s, go a distance, m, if they speed up to `CRUISE` freely."""
    distance, top = np.maximum(distance, 0.0), np.maximum(speed, CRUISE)
    until = (top**2 - speed**2) / (2 * GOES)
    quick = (np.sqrt(speed**2 + 2 * GOES * distance) - speed) / GOES
    return np.where(distance <= until, quick, (top - speed) / GOES + (distance - until) / top)


def _meetings(
    paths: Paths, position: FloatArray, heading: FloatArray, speed: FloatArray, walks: BoolArray
) -> tuple[Meetings, FloatArray]:
    """Where vehicles meet, and people who cross their ways, each pair in both orders; and the distance (k,), m, to the
    next vehicle before each."""
    step = np.arange(0.0, 1.0, SPACING / PATH_STEP)[:, None]
    begin, piece = paths.position[:, :-1, None], np.diff(paths.position, axis=1)[:, :, None]
    onward = (begin + step * piece).reshape(len(paths), begin.shape[1] * len(step), 2)
    behind = position[:, None] + SPACING * np.arange(-BEHIND, 0)[:, None] * unit(heading)[:, None]
    points = np.concatenate([behind, onward], axis=1)
    course = np.repeat(paths.heading[:, 1:], len(step), axis=1)
    course = np.concatenate([np.repeat(heading[:, None], BEHIND, axis=1), course], axis=1)
    far = np.where(walks, WALKED, np.minimum(LOOKS + AHEAD * speed, FARTHEST))
    reach = np.minimum((far / SPACING).astype(np.int64) + BEHIND, points.shape[1])
    pair, at = path_meetings(points, reach, NEAR, SPACING)
    crosses = np.abs(np.cos(np.subtract(*course[pair, at].T))) < ALIKE
    people = walks[pair].sum(axis=1)
    kept = (people == 0) | ((people == 1) & crosses)
    pair, at = pair[kept], at[kept]
    distance, angle = SPACING * (at - BEHIND), course[pair, at]
    cosine = np.cos(angle[:, 0] - angle[:, 1])
    lead, begins = np.full(len(paths), np.inf), distance <= SPACING
    in_line = (cosine > ALIKE) & begins.any(axis=1)
    own = np.where(begins[:, 0], 1, 0)[in_line]
    each = np.arange(len(own))
    gap = distance[in_line][each, own] - distance[in_line][each, 1 - own]
    follows = gap > 0
    np.minimum.at(lead, pair[in_line][each, own][follows], gap[follows])
    met = np.flatnonzero(~in_line & (cosine > HEAD_ON))
    rows, distances = (np.concatenate([each[met], each[met, ::-1]]) for each in (pair, distance))
    return Meetings(rows, distances, np.tile(cosine[met], 2)), lead


def _evidence(meetings: Meetings, columns: FloatArray) -> FloatArray:
    """(E, F) evidence on pairs i, j, of order one, by half lengths, speeds and so on (k, 8) of each."""
    half, speed, acceleration, to_line, halts, lead, arrival, walks = np.moveaxis(columns[meetings.rows], 2, 0)
    front, later = meetings.distance - half, np.clip(arrival[:, 0] - arrival[:, 1], -3.0, 3.0)
    comes = np.maximum(front, 0.0) / np.maximum(speed, np.where(walks > 0, LINGERS, SLOW))
    braking = speed**2 / (8 * np.maximum(to_line, 0.3))
    both = (
        np.clip(front, -5.0, 50.0) / 20,
        np.clip(meetings.distance + half, -4.0, 8.0) / 4,
        np.clip(to_line, -6.0, 40.0) / 15,
        speed / 8,
        np.clip(acceleration, -3.0, 3.0) / 2,
        np.minimum(free_time(front, speed), 10.0) / 4,
        np.minimum(comes, 10.0) / 4,
        np.minimum(braking, 2.0),
        np.clip(lead - np.maximum(to_line, 0.0) - 2, -8.0, 4.0) / 6,
        np.clip(lead - meetings.distance, -8.0, 8.0) / 8,
        halts,
    )
    first = walks[:, 0] - walks[:, 1]
    return np.column_stack([*both, meetings.cosine > ALIKE, meetings.cosine, np.tanh(2 * later), later / 2, first])

"""Edges that answer for themselves: with what probability a rule governs an object, by what came of its predictions.

Stop lines are learned from traffic, as places where vehicles halt with nobody before them. A vehicle halts at a place
if it stands there for `STANDING` s while it is detected, has moved before, and no vehicle is on its way within `FREE`
m. Places of halts in one lane and direction are one, a line across the lane. It has counts of the vehicles that halted
at it before they crossed, h, and of those that crossed without, c; the next one halts there with the probability

    p = h / ( h + c + 1 )

Stop lines of a map that no light governs are such lines from the start, one in each lane, as if `KNOWN` vehicles had
passed, of which the share `HALTING` halted; counts of traffic are added. At a stop sign so many halt for nobody, too.

Who halts at a line no longer follows a leader that has crossed it: a vehicle that has not is on its own.

While an object and those that act on it are detected, edges make predictions that can be checked. Every `HORIZON` s the
velocity u of an object is taken from its places now and then, as the estimate has been pulled by the edge already. Over
the next h s edges change the mean velocity by

    du = a ( 1 - (1 - exp(-K h)) / (K h) ) / K,    a = sum_j K_j law(x_i, x_j),    K = sum_j K_j

and a trial compares that with no change by a log-likelihood ratio,

    l = ( |u' - u|^2 - |u' - u - du|^2 ) / ( 2 s^2 ),    s^2 = 2 variance of v + ( `ACCELERATION` h )^2

which is near 0 where the edge asks for little, and strongly negative where a vehicle waits at a line that its leader
has crossed. Ratios of the pair of an object and its strongest source are summed, and fade; so are, each worth less,
those of all pairs of the rule at this place (tiles of `TILE` m, by direction) and everywhere. Sources that are faster
and slower have records of their own: who waits for a gap does not follow a leader that leaves, but one that brakes. The
probability that the edge governs,

    p = 1 / ( 1 + exp( -( l_0 + l_pair + l_place + l_rule ) ) ),    l_0 = log( prior / (1 - prior) )

scales its rate, and so does 1 - the probability that the object halts at a line that a faster source has crossed.
Rules that read the map are taken at their word.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from saga_fg.model import (
    POSITION,
    VELOCITY,
    EdgeRule,
    Governing,
    NodeTable,
    SceneGraph,
    ahead_and_aside,
    build_graph,
    unit,
)
from saga_fg.numerics import BoolArray, Columns, FloatArray, IntArray, of_classes, wrap_angle
from saga_fg.types import VEHICLES, StopLine

STANDING = 0.6  # s
STILL, LEAVES = 0.5, 1.5  # m/s: slower vehicles stand; from this speed on they have left
FREE = 12.0  # m, between centres
LANE = 1.8  # m to either side of a lane's middle
ALIKE = 0.5  # rad
BEFORE, BEYOND = 40.0, 3.0  # m before a line and beyond it, within which it concerns vehicles
ONE_LINE = 5.0  # m along the lane, within which halts are at one line
KNOWN, HALTING = 10.0, {"stop": 0.9, "yield": 0.4, "crossing": 0.4}  # vehicles, and the share that halts, by sign
FRONT = 2.75  # m from a line of the map to the middle of a car that halts there
LIKELY = 0.3  # probability of a halt from which vehicles come to a line


@dataclass(frozen=True, eq=False)
class Lines(Columns):
    """k lines: position (k, 2), m, heading (k,), rad, counts (k,) of vehicles that halted and that crossed without, and
    share (k,) that halts for nobody."""

    position: FloatArray
    heading: FloatArray
    halted: FloatArray
    crossed: FloatArray
    alone: FloatArray

    @classmethod
    def none(cls) -> Lines:
        """No line."""
        return cls(np.empty((0, 2)), *np.empty((4, 0)))

    @property
    def probability(self) -> FloatArray:
        """(k,) with which the next vehicle halts."""
        return np.asarray(self.halted / (self.halted + self.crossed + 1))

    def beyond(self, position: FloatArray) -> FloatArray:
        """(n, k) m by which places (n, 2) are beyond each line."""
        return ahead_and_aside(position[:, None] - self.position, unit(self.heading))[0]

    def approached(self, position: FloatArray, heading: FloatArray) -> BoolArray:
        """(n, k) whether vehicles are in the lane of each line, and go its way."""
        _, aside = ahead_and_aside(position[:, None] - self.position, unit(self.heading))
        return np.asarray((np.abs(aside) < LANE) & (np.abs(wrap_angle(heading[:, None] - self.heading)) < ALIKE))

    def next_of(self, position: FloatArray, heading: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Distance (n,), m, of vehicles from the line before them, infinite: none; shares that halt, and for nobody."""
        none = np.zeros(len(position))
        if len(self) == 0:
            return none + np.inf, none, none
        ahead = -self.beyond(position)
        near = self.approached(position, heading) & (ahead < BEFORE) & (ahead > -BEYOND) & (self.probability > LIKELY)
        distance = np.where(near, ahead, np.inf)
        nearest, each = distance.argmin(axis=1), np.arange(len(position))
        found = distance[each, nearest]
        halts, alone = (np.where(np.isfinite(found), p[nearest], 0.0) for p in (self.probability, self.alone))
        return found, halts, alone


@dataclass(frozen=True, eq=False)
class HaltingPlaces:
    """Lines, and of the vehicles near them: since when each stands, s, which have halted where, and how far each was
    beyond the lines, m."""

    lines: Lines = field(default_factory=Lines.none)
    since: Mapping[int, float] = field(default_factory=dict)
    halted: frozenset[tuple[int, int]] = frozenset()
    beyond: Mapping[int, FloatArray] = field(default_factory=dict)

    def without(self, nodes: set[int]) -> HaltingPlaces:
        """Without what is known of some vehicles; lines stay."""
        since = {node: then for node, then in self.since.items() if node not in nodes}
        beyond = {node: far for node, far in self.beyond.items() if node not in nodes}
        return HaltingPlaces(self.lines, since, frozenset(p for p in self.halted if p[0] not in nodes), beyond)

    def with_lines(self, stop_lines: Iterable[StopLine], origin: FloatArray) -> HaltingPlaces:
        """With the lines of a map that no light governs, in coordinates about `origin` (2,)."""
        lines = self.lines
        for line in stop_lines:
            if not line.light:
                across = line.ends[0] - line.ends[1]
                n = max(1, round(float(np.hypot(*across)) / (2 * LANE)))
                place = line.ends[1] - origin + (np.arange(n)[:, None] + 0.5) / n * across
                share, heading = np.full(n, HALTING[line.sign]), np.full(n, line.heading)
                counts, alone = (KNOWN * share, KNOWN * (1 - share) - 1), share * (line.sign == "stop")
                lines = lines.append(Lines(place - FRONT * unit(heading), heading, *counts, alone))
        return replace(self, lines=lines)

    def across(self, nodes: NodeTable, target: IntArray, source: IntArray) -> FloatArray:
        """(E,) probability that a line ends the edge from `source` to `target`, rows of nodes: halts between them."""
        own, other = (self.lines.beyond(nodes.position[rows]) for rows in (target, source))
        near = self.lines.approached(nodes.position[target], nodes.heading[target])
        between = near & (own > -BEFORE) & (own < BEYOND) & (other > BEYOND)
        return np.asarray(np.where(between, self.lines.probability, 0.0).max(axis=1, initial=0.0))

    def later(self, nodes: NodeTable, seen: BoolArray, time: float) -> HaltingPlaces:
        """With what vehicles do that are `seen` (n,), the first rows of `nodes`."""
        rows = np.flatnonzero(seen & of_classes(nodes.label, VEHICLES)[: len(seen)])
        ids, position, heading = nodes.id[rows].tolist(), nodes.position[rows], nodes.heading[rows]
        speed = np.hypot(*nodes.velocity[rows].T)
        still = (speed < STILL) & (nodes.has_moved[rows].astype(np.float64) > 0.5)
        since = {
            node: self.since.get(node, time)
            for node, stands, v in zip(ids, still.tolist(), speed.tolist(), strict=True)
            if stands or (node in self.since and v < LEAVES)
        }
        found = self._crossings(ids, position, heading)
        new = [k for k in np.flatnonzero(still).tolist() if since[ids[k]] <= time - STANDING]
        if new:
            free = _nobody_before(position, heading, np.array(new, dtype=np.int64))
            for k in np.array(new)[free].tolist():
                found = found._halt(ids[k], position[k], float(heading[k]))
        beyond = dict(zip(ids, found.lines.beyond(position), strict=True)) if len(found.lines) else {}
        here = set(ids)
        kept = frozenset(pair for pair in found.halted if pair[0] in here or pair[0] in self.since)
        return HaltingPlaces(found.lines, since, kept, beyond)

    def _crossings(self, ids: list[int], position: FloatArray, heading: FloatArray) -> HaltingPlaces:
        """With the vehicles that have crossed lines since, which have not halted there."""
        now, near = self.lines.beyond(position), self.lines.approached(position, heading)
        crossed = self.lines.crossed.copy()
        for row, node in enumerate(ids):
            then = self.beyond.get(node)
            if then is not None:
                for k in np.flatnonzero(near[row, : len(then)] & (then <= BEYOND) & (now[row, : len(then)] > BEYOND)):
                    crossed[k] += (node, int(k)) not in self.halted
        return replace(self, lines=replace(self.lines, crossed=crossed))

    def _halt(self, node: int, position: FloatArray, heading: float) -> HaltingPlaces:
        """With a halt of a vehicle."""
        lines = self.lines
        alike = lines.approached(position[None], np.array([heading]))[0]
        alike &= np.abs(lines.beyond(position[None])[0]) < ONE_LINE
        if not alike.any():
            line = Lines(position[None], np.array([heading]), np.ones(1), *np.zeros((2, 1)))
            return replace(self, lines=lines.append(line), halted=self.halted | {(node, len(lines))})
        k = int(np.flatnonzero(alike)[0])
        if (node, k) in self.halted:
            return self
        count, share = lines.halted.copy(), 1 / (lines.halted[k] + 1)
        count[k] += 1
        place = lines.position.copy()
        place[k] += share * (position - place[k])
        return replace(self, lines=replace(lines, halted=count, position=place), halted=self.halted | {(node, k)})


def _nobody_before(position: FloatArray, heading: FloatArray, rows: IntArray) -> BoolArray:
    """(k,) which of `rows` have no other vehicle within `FREE` on their way."""
    ahead, aside = ahead_and_aside(position[:, None] - position[rows], unit(heading[rows]))
    turned = np.abs(wrap_angle(heading[:, None] - heading[rows]))
    before = (ahead > 0.5) & (ahead < FREE) & (np.abs(aside) < LANE) & (turned < math.pi / 3)
    return np.asarray(~before.any(axis=0))


HORIZON, MAX_HORIZON = 1.0, 2.0  # s, of a trial
ACCELERATION = 1.0  # m/s^2, standard deviation of what drivers do without an edge
MAX_RATIO = 4.0  # of one trial, either way
TILE = 8.0  # m
DIRECTIONS = 4
MIN_PRIOR = 1e-9
MIN_SUM = 0.05  # a record below is forgotten

Key = tuple[int, ...]
_PAIR_KEY = 4  # numbers: rule, whether the source is faster, target, source; a place has more, a rule has less


class Memory(NamedTuple):
    """How records add up: share of a trial, bounds of the sum, time in which it fades, s."""

    share: float
    low: float
    high: float
    time: float


PAIR = Memory(1.0, -6.0, 2.0, 20.0)
PLACE = Memory(0.5, -4.0, 2.0, 120.0)
RULE = Memory(0.1, -4.0, 2.0, 300.0)


class Trials(NamedTuple):
    """n trials, with what was known at their begin: keys of the pairs and places, ids (n,); u (n, 2), m/s, the variance
    of v (n,), a (n, 2), m/s^2, K (n,), 1/s."""

    pair: tuple[Key, ...]
    place: tuple[Key, ...]
    target: IntArray
    velocity: FloatArray
    variance: FloatArray
    acceleration: FloatArray
    rate: FloatArray

    def select(self, rows: list[int]) -> Trials:
        """Some trials."""
        pair, place, *columns = tuple[Any, ...](self)
        return Trials(tuple(pair[k] for k in rows), tuple(place[k] for k in rows), *(one[rows] for one in columns))


@dataclass(frozen=True, eq=False)
class EdgeRecord:
    """Sums of log-likelihood ratios, with the time of each, s, by rule, whether the source is faster, and pair, place
    or nothing else.

    time, places, trials   when the last trials began, where the objects were, and these
    """

    sums: Mapping[Key, tuple[float, float]] = field(default_factory=dict)
    time: float = -math.inf
    places: Mapping[int, FloatArray] = field(default_factory=dict)
    trials: tuple[Trials, ...] = ()

    def log_odds(self, keys: Iterable[Key], memory: Memory, time: float) -> FloatArray:
        """Sums of log-likelihood ratios (k,) of keys, faded until `time`."""
        found = (self.sums.get(key) for key in keys)
        return np.array([0.0 if one is None else one[0] * math.exp((one[1] - time) / memory.time) for one in found])

    def without(self, nodes: set[int]) -> EdgeRecord:
        """Without the pairs of any of some nodes."""
        sums = {key: one for key, one in self.sums.items() if len(key) != _PAIR_KEY or nodes.isdisjoint(key[2:])}
        places = {node: place for node, place in self.places.items() if node not in nodes}
        kept = ([k for k, key in enumerate(one.pair) if nodes.isdisjoint(key[2:])] for one in self.trials)
        trials = tuple(one.select(rows) for one, rows in zip(self.trials, kept, strict=True))
        return EdgeRecord(sums, self.time, places, trials)

    def governing(
        self, rules: Sequence[EdgeRule], halting: HaltingPlaces, prior: float, time: float
    ) -> Governing | None:
        """The probabilities that edges govern now, for `build_graph`; None where the `prior` is 1."""
        if prior == 1:
            return None
        usual = math.log(max(prior, MIN_PRIOR) / (1 - prior))

        def probabilities(number: int, nodes: NodeTable, target: IntArray, source: IntArray) -> FloatArray:
            if not answers(rules[number]):
                return np.ones(len(target))
            rows, back = np.unique(target, return_inverse=True)
            faster, places = _faster(nodes, target, source).astype(np.int64), _places(nodes, rows)
            ends = zip(faster.tolist(), nodes.id[target].tolist(), nodes.id[source].tolist(), strict=True)
            there = zip(faster.tolist(), back.tolist(), strict=True)
            known = self.log_odds([(number, *pair) for pair in ends], PAIR, time)
            known = known + self.log_odds([(number, sign, *places[row]) for sign, row in there], PLACE, time)
            known = known + self.log_odds([(number, 0), (number, 1)], RULE, time)[faster]
            own = 1 / (1 + np.exp(-(usual + known)))
            return np.asarray(own * np.where(faster, 1 - halting.across(nodes, target, source), 1.0))

        return probabilities

    def later(self, rules: Sequence[EdgeRule], nodes: NodeTable, seen: BoolArray, time: float) -> EdgeRecord:
        """Judge the trials that are over, and begin others; `seen` (n,) are detected, the first rows of `nodes`."""
        h = time - self.time
        if h < HORIZON - 1e-6:
            return self
        rows = np.flatnonzero(seen)
        places = dict(zip(nodes.id[rows].tolist(), nodes.position[rows], strict=True))
        if h > MAX_HORIZON:
            return EdgeRecord(self.sums, time, places)
        known = {node: row for node, row in zip(places, rows.tolist(), strict=True) if node in self.places}
        velocity = nodes.velocity.copy()
        for node, row in known.items():
            velocity[row] = (places[node] - self.places[node]) / h
        nodes = replace(nodes, velocity=velocity)
        sums = dict(self.sums)
        for trials in self.trials:
            _judge(sums, trials, nodes, known, h, time)
        able = np.isin(np.arange(len(nodes)), list(known.values()))
        begun = (_trials(number, rule, nodes, able) for number, rule in enumerate(rules) if answers(rule))
        kept = {key: one for key, one in sums.items() if abs(one[0]) > MIN_SUM}
        return EdgeRecord(kept, time, places, tuple(one for one in begun if one is not None))


def _judge(
    sums: dict[Key, tuple[float, float]],
    trials: Trials,
    nodes: NodeTable,
    row_of: Mapping[int, int],
    h: float,
    time: float,
) -> None:
    """Add to the sums what came of trials that began h s ago."""
    kept = np.array([k for k, node in enumerate(trials.target.tolist()) if node in row_of], dtype=np.int64)
    rows = np.array([row_of[node] for node in trials.target[kept].tolist()], dtype=np.int64)
    K = trials.rate[kept, None]
    change = nodes.velocity[rows] - trials.velocity[kept]
    asked = trials.acceleration[kept] * (1 + np.expm1(-K * h) / (K * h)) / K
    variance = trials.variance[kept] + nodes.velocity_variance[rows] + (ACCELERATION * h) ** 2
    ratio = ((change**2).sum(axis=1) - ((change - asked) ** 2).sum(axis=1)) / (2 * variance)
    for k, value in zip(kept.tolist(), np.clip(ratio, -MAX_RATIO, MAX_RATIO).tolist(), strict=True):
        for key, memory in ((trials.pair[k], PAIR), (trials.place[k], PLACE), (trials.pair[k][:2], RULE)):
            before, then = sums.get(key, (0.0, time))
            total = before * math.exp((then - time) / memory.time) + memory.share * value
            sums[key] = min(max(total, memory.low), memory.high), time


def answers(rule: EdgeRule) -> bool:
    """True if a rule is between objects alone."""
    return not getattr(rule, "map_classes", ())


def _faster(nodes: NodeTable, target: IntArray, source: IntArray) -> BoolArray:
    """(E,) whether sources are faster than targets, each along its heading."""
    speed = np.einsum("ni,ni->n", nodes.velocity, unit(nodes.heading))
    return np.asarray(speed[source] > speed[target])


def _places(nodes: NodeTable, rows: IntArray) -> list[Key]:
    """Tile and direction of some nodes."""
    tiles = np.floor(nodes.position[rows] / TILE).astype(np.int64)
    direction = np.floor((nodes.heading[rows] / (2 * np.pi / DIRECTIONS) + 0.5) % DIRECTIONS).astype(np.int64)
    return [(*tile, -1 - quarter) for tile, quarter in zip(tiles.tolist(), direction.tolist(), strict=True)]


def _trials(number: int, rule: Any, nodes: NodeTable, able: BoolArray) -> Trials | None:
    """The trials of one rule that begin now; None where it ties none of the `able` (n,)."""
    if is_dataclass(rule) and not isinstance(rule, type) and getattr(rule, "information_gain", False):
        rule = replace(rule, information_gain=False)  # as if the objects were hidden
    graph, n = build_graph(nodes, (rule,)), len(nodes)
    pulls = list(_pulls(graph, nodes))
    if not pulls:
        return None
    target, source, rate, pull = (np.concatenate(column) for column in zip(*pulls, strict=True))
    a, strongest = np.zeros((n, 2)), np.full(n, -1)
    K = np.bincount(target, weights=rate, minlength=n).astype(np.float64)
    np.add.at(a, target, rate[:, None] * pull)
    order = np.argsort(rate, kind="stable")
    strongest[target[order]] = source[order]  # the last one, of the highest rate, stays
    rows = np.flatnonzero(able & (strongest >= 0) & able[strongest])
    if len(rows) == 0:
        return None
    ids = nodes.id[rows]
    faster = _faster(nodes, rows, strongest[rows]).astype(np.int64).tolist()
    ends = zip(faster, ids.tolist(), nodes.id[strongest[rows]].tolist(), strict=True)
    places = zip(faster, _places(nodes, rows), strict=True)
    keys = tuple((number, *pair) for pair in ends), tuple((number, one, *place) for one, place in places)
    return Trials(*keys, ids, nodes.velocity[rows], nodes.velocity_variance[rows], a[rows], K[rows])


def _pulls(graph: SceneGraph, nodes: NodeTable) -> Iterator[tuple[IntArray, IntArray, FloatArray, FloatArray]]:
    """Target, source, rate (E,) and law(x_i, x_j) (E, 2), m/s^2, of the edges of a graph."""
    states = np.concatenate([nodes.position, nodes.velocity], axis=1)
    for group in graph.edges:
        own, other = nodes.types[group.target[0]], nodes.types[group.source[0]]
        v, at = own.index(VELOCITY), own.index(POSITION + VELOCITY)
        of = other.index(POSITION + VELOCITY if other.has(VELOCITY) else POSITION)
        pull = np.einsum("eij,ej->ei", group.A_self[:, v[:, None], at], states[group.target]) + group.b[:, v]
        pull += np.einsum("eij,ej->ei", group.A_other[:, v[:, None], of], states[group.source, : len(of)])
        yield group.target, group.source, group.rate, pull
    for edges in graph.nonlinear:
        law = edges.law.accelerations(states[edges.target], states[edges.source], edges.given)
        yield edges.target, edges.source, edges.rate, law.value

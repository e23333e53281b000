"""Places where vehicles halt with nobody before them: stop lines, learned from traffic.

A vehicle halts at a place if it stands there for `STANDING` s while it is detected, has moved before, and no vehicle is
on its way within `FREE` m. Places of halts in one lane and direction are one, a line across the lane. It has counts of
the vehicles that halted at it before they crossed, h, and of those that crossed without, c; the next one halts there
with the probability

    p = h / ( h + c + 1 )

Who halts at a line no longer follows a leader that has crossed it: a vehicle that has not is on its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from saga_fg.model import NodeTable, ahead_and_aside, unit
from saga_fg.numerics import BoolArray, Columns, FloatArray, IntArray, of_classes, wrap_angle
from saga_fg.types import VEHICLES

STANDING = 0.6  # s
STILL, LEAVES = 0.5, 1.5  # m/s: slower vehicles stand; from this speed on they have left
FREE = 12.0  # m, between centres
LANE = 1.8  # m to either side of a lane's middle
ALIKE = 0.5  # rad
BEFORE, BEYOND = 40.0, 3.0  # m before a line and beyond it, within which it concerns vehicles
ONE_LINE = 5.0  # m along the lane, within which halts are at one line


@dataclass(frozen=True, eq=False)
class Lines(Columns):
    """k lines: position (k, 2), m, heading (k,), rad, counts (k,) of vehicles that halted and that crossed without."""

    position: FloatArray
    heading: FloatArray
    halted: FloatArray
    crossed: FloatArray

    @classmethod
    def none(cls) -> Lines:
        """No line."""
        return cls(np.empty((0, 2)), np.empty(0), np.empty(0), np.empty(0))

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
            line = Lines(position[None], np.array([heading]), np.ones(1), np.zeros(1))
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

"""Approaches of vehicles to stop lines: the way along a lane of the map or straight ahead, and the first in each lane.

A vehicle approaches a line along a lane of the map that crosses the line, or else straight along its heading, as where
a lane ends before the line.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from saga_fg.model.interactions import NodeTable, unit
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, of_classes
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.types.lanes_across import LanesAcross
from saga_fg.types.road_map import STOP_LINE

SIDE_BY_SIDE = 1.8  # m; vehicles that cross a line further apart are in different lanes
PAST = 2.0  # m; a vehicle waits at a line with its front up to this far beyond it


class Approach(NamedTuple):
    """E pairs of a vehicle and a stop line: whether it comes to it, the way to it (from the centre, along the lane),
    m, the direction of the lane at the vehicle (E, 2), and where it will cross the line, m to the left of its middle.
    """

    comes: BoolArray
    way: FloatArray
    direction: FloatArray
    crossing: FloatArray

    def select(self, rows: IntArray | BoolArray) -> Approach:
        """Some of the pairs."""
        return Approach(self.comes[rows], self.way[rows], self.direction[rows], self.crossing[rows])


def approach(nodes: NodeTable, target: IntArray, source: IntArray) -> Approach:
    """The approaches of vehicles `target` (E,) to stop lines `source` (E,)."""
    wanted = target * len(nodes) + source
    if "approach" in nodes.derived:
        pairs, known = nodes.derived["approach"]
        at = np.searchsorted(pairs, wanted).clip(max=max(len(pairs) - 1, 0))
        if len(pairs) and (pairs[at] == wanted).all():
            found: Approach = known.select(at)
            return found
    found = _approach(nodes, target, source)
    order = np.argsort(wanted)
    nodes.derived["approach"] = wanted[order], found.select(order)
    return found


def _approach(nodes: NodeTable, target: IntArray, source: IntArray) -> Approach:
    offset = nodes.position[source] - nodes.position[target]
    u = unit(nodes.heading[target])
    way = np.einsum("ei,ei->e", offset, u)
    ends = _ends(nodes, source)
    aside = u[:, 0] * offset[:, 1] - u[:, 1] * offset[:, 0]  # of the line's middle, to the left of the vehicle's path
    aligned = np.abs(wrap_angle(nodes.heading[target] - nodes.heading[source])) < math.pi / 4
    comes = (np.abs(aside) < np.hypot(*(ends[:, 0] - ends[:, 1]).T) / 2) & aligned & (way > 0)
    found = Approach(comes, way, u, -aside)
    if nodes.lanes is not None:
        _follow_lanes(found, nodes, nodes.lanes, target, source)
    return found


def _follow_lanes(found: Approach, nodes: NodeTable, lanes: LanesAcross, target: IntArray, source: IntArray) -> None:
    """Change the approaches of those in a lane that crosses the line, to that of the nearest such lane."""
    vehicles, vehicle = np.unique(target, return_inverse=True)
    there = lanes.inside(nodes.position[vehicles], unit(nodes.heading[vehicles]))
    foot = np.full((len(vehicles), len(lanes.centre)), -1)
    foot[there.vehicle, there.lane] = np.arange(len(there.vehicle))
    row, crossed = lanes.crossings(source)
    of = foot[vehicle[row], lanes.lane[crossed]]
    row, crossed, at = row[of >= 0], crossed[of >= 0], there.feet.select(of[of >= 0])
    order = np.lexsort((np.abs(at.e), row))
    nearest = order[np.unique(row[order], return_index=True)[1]]
    row, crossed, at = row[nearest], crossed[nearest], at.select(nearest)
    found.way[row], found.crossing[row] = lanes.s[crossed] - at.s, at.e - lanes.e[crossed]
    found.direction[row], found.comes[row] = at.direction, lanes.s[crossed] > at.s


class ComingVehicles(NamedTuple):
    """E pairs of a vehicle that comes to a stop line and the line (rows of a `NodeTable`), with the approach, the speed
    along it, m/s, and the way left to the front of the vehicle, m, negative where it is past the line."""

    target: IntArray
    source: IntArray
    approach: Approach
    speed: FloatArray
    front: FloatArray

    def select(self, rows: IntArray | BoolArray) -> ComingVehicles:
        """Some of the pairs."""
        return ComingVehicles(
            self.target[rows], self.source[rows], self.approach.select(rows), self.speed[rows], self.front[rows]
        )

    def first(self) -> ComingVehicles:
        """The first vehicle of each lane."""
        crossing, way = self.approach.crossing, self.approach.way
        one_lane = (self.source[:, None] == self.source) & (np.abs(crossing[:, None] - crossing) < SIDE_BY_SIDE)
        return self.select(~(one_lane & (way < way[:, None])).any(axis=1))


def _ends(nodes: NodeTable, source: IntArray) -> FloatArray:
    """Left and right ends (E, 2, 2) of lines about their middles, m."""
    lines, row = np.unique(source, return_inverse=True)
    return np.array([nodes.outline[j] for j in lines.tolist()]).reshape(-1, 2, 2)[row]


def _near(nodes: NodeTable, classes: tuple[str, ...], max_distance: float) -> tuple[IntArray, IntArray]:
    """Vehicles and lines within some distance of each other (E,)."""
    lines = np.flatnonzero(nodes.label == STOP_LINE)
    vehicles = np.flatnonzero(of_classes(nodes.label, classes))
    target, source = np.repeat(vehicles, len(lines)), np.tile(lines, len(vehicles))
    near = np.hypot(*(nodes.position[target] - nodes.position[source]).T) <= max_distance
    return target[near], source[near]


def coming_vehicles(nodes: NodeTable, classes: tuple[str, ...], max_distance: float) -> ComingVehicles:
    """All vehicles that come to a line within some distance; those that wait a little past it among them."""
    key = ("coming", classes, max_distance)
    if key not in nodes.derived:
        target, source = _near(nodes, classes, max_distance)
        ways = approach(nodes, target, source)
        speed = np.maximum(np.einsum("ei,ei->e", nodes.velocity[target], ways.direction), 0.0)
        front = ways.way - nodes.length[target] / 2
        found = ComingVehicles(target, source, ways, speed, front)
        nodes.derived[key] = found.select(ways.comes & (front > -PAST))
    coming: ComingVehicles = nodes.derived[key]
    return coming


def passed_vehicles(nodes: NodeTable, classes: tuple[str, ...], max_distance: float) -> ComingVehicles:
    """All vehicles that have crossed a line straight on and are within some distance of it."""
    target, source = _near(nodes, classes, max_distance)
    beyond, across = nodes.position[target] - nodes.position[source], unit(nodes.heading[source])
    ends = _ends(nodes, source)
    aside = across[:, 0] * beyond[:, 1] - across[:, 1] * beyond[:, 0]
    passed = np.einsum("ei,ei->e", beyond, across)
    aligned = np.abs(wrap_angle(nodes.heading[target] - nodes.heading[source])) < math.pi / 4
    inside = (passed > 0) & aligned & (np.abs(aside) < np.hypot(*(ends[:, 0] - ends[:, 1]).T) / 2)
    u = unit(nodes.heading[target])
    speed = np.maximum(np.einsum("ei,ei->e", nodes.velocity[target], u), 0.0)
    front = -passed - nodes.length[target] / 2
    return ComingVehicles(target, source, Approach(inside, -passed, u, aside), speed, front).select(inside)

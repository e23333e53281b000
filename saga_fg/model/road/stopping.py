r"""A closed stop line brings the first vehicle to a halt, and through it the queue.

    dv_i/dt += rate tau u ( -v^2 / (2 g) ),    v = u.v_i,    g = u.(p_j - p_i) + bend - length_i / 2 - margin

is the constant deceleration that ends at the line: v the speed along the lane, g the remaining way from the front of
the vehicle to `margin` before the line, `bend` the extra length of the way along the lane over the straight one.
Linearised at the estimate (v0, g0):

    -v^2 / (2 g) ~ -v0^2 / (2 g0) - (v0 / g0) (v - v0) + v0^2 / (2 g0^2) (g - g0)

The rule: of the vehicles that come to a line, the first of each lane that can still stop, at

    rate = rate  closed_j  ramp( v^2 / (2 g) from `reaction_deceleration` to `full_deceleration` )

since drivers do not brake for a line far away; a vehicle that would have to brake harder than `max_deceleration` goes
on. Those behind follow by other interactions. A vehicle approaches a line along its lane of the map, or without lanes
straight along its heading. Alternatively the line is a stationary leader of the Intelligent Driver Model
(`saga_fg.model.intelligent_driver`): the vehicle brakes later and harder, and a slow one creeps up to the line.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from saga_fg.model.edge_rules import VEHICLES, Pairs
from saga_fg.model.intelligent_driver import LEAST_GAP, IntelligentDriver, Linearised, accelerated, speed_along
from saga_fg.model.interactions import POSITION, VELOCITY, Needs, NodeTable, Triples, unit
from saga_fg.model.nonlinear_interactions import Accelerations, smooth_acceleration
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, of_classes
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.numerics.polyline import feet, on_it
from saga_fg.settings import NonNegative, Positive, Settings, setting, settings_group
from saga_fg.types.road_map import LANE, STOP_LINE

SIDE_BY_SIDE = 1.8  # m; vehicles that cross a line further apart are in different lanes


class Approach(NamedTuple):
    """E pairs of a vehicle and a stop line: whether it comes to it, the way to it (from the centre, along the lane),
    m, the direction of the lane at the vehicle (E, 2), and where it will cross the line, m to the left of its middle.
    """

    comes: BoolArray
    way: FloatArray
    direction: FloatArray
    crossing: FloatArray


def approach(nodes: NodeTable, target: IntArray, source: IntArray) -> Approach:
    """The approaches of vehicles `target` (E,) to stop lines `source` (E,)."""
    offset = nodes.position[source] - nodes.position[target]
    u = facing = unit(nodes.heading[target])
    way = np.einsum("ei,ei->e", offset, u)
    left, right = (np.array([nodes.outline[j][end] for j in source.tolist()]).reshape(-1, 2) for end in (0, 1))
    aside = u[:, 0] * offset[:, 1] - u[:, 1] * offset[:, 0]  # of the line's middle, to the left of the vehicle's path
    half = np.hypot(*(left - right).T) / 2
    aligned = np.abs(wrap_angle(nodes.heading[target] - nodes.heading[source])) < math.pi / 4
    comes = (np.abs(aside) < half) & aligned & (way > 0)
    crossing = -aside
    (vehicles, of_vehicle), (lines, of_line) = (np.unique(rows, return_inverse=True) for rows in (target, source))
    for lane in np.flatnonzero(nodes.label == LANE).tolist() if len(target) else ():
        centre, width = nodes.outline[lane], nodes.width[lane]
        mine = feet(centre, nodes.position[vehicles]).select(of_vehicle)
        its = feet(centre, nodes.position[lines]).select(of_line)
        in_lane = (np.abs(mine.e) <= width / 2) & (np.einsum("ei,ei->e", mine.direction, facing) > 0)
        in_lane &= on_it(centre, mine.s)
        crossed = (np.abs(its.e) <= half) & (np.cos(np.arctan2(*its.direction.T[::-1]) - nodes.heading[source]) > 0)
        way = np.where(in_lane & crossed, its.s - mine.s, way)
        comes = np.where(in_lane, crossed & (its.s > mine.s), comes)
        crossing = np.where(in_lane & crossed, mine.e - its.e, crossing)
        u = np.where(in_lane[:, None], mine.direction, u)
    return Approach(comes, way, u, crossing)


@dataclass(frozen=True)
class Stopping(Settings):
    """Even deceleration to a halt before a line; the source is the line."""

    needs: ClassVar[Needs] = (POSITION + VELOCITY, POSITION)
    time_constant: Positive = setting(1.0, "tau: an edge of rate 1 / tau decelerates as much as is needed, s")
    margin: NonNegative = setting(
        3.0, "distance left between the front of a stopped vehicle and the line, m; usual 1 to 5"
    )

    def gap(self, nodes: NodeTable, target: IntArray, way: FloatArray) -> FloatArray:
        """g (E,), m, for ways (E,) from the centres to the line."""
        return np.maximum(way - nodes.length[target] / 2 - self.margin, LEAST_GAP)

    def triples(self, nodes: NodeTable, target: IntArray, source: IntArray) -> Triples:
        ways = approach(nodes, target, source)
        g, v = self.gap(nodes, target, ways.way), speed_along(nodes, target, ways.direction)
        braking = Linearised(-(v**2) / (2 * g), -v / g, v**2 / (2 * g**2), np.zeros_like(v))
        return accelerated(nodes, target, source, ways.direction, v, braking, self.time_constant)


@dataclass(frozen=True)
class DriverStopping:
    """Coming to a line as to the end of a queue; the source is the line."""

    needs: ClassVar[Needs] = (POSITION + VELOCITY, POSITION)
    driver: IntelligentDriver = settings_group(
        IntelligentDriver, "parameters of the driver; its standstill gap is to the line"
    )

    def gap(self, nodes: NodeTable, target: IntArray, way: FloatArray) -> FloatArray:
        """Gap (E,), m, for ways (E,) from the centres to the line."""
        return np.maximum(way - nodes.length[target] / 2, LEAST_GAP)

    def triples(self, nodes: NodeTable, target: IntArray, source: IntArray) -> Triples:
        ways = approach(nodes, target, source)
        v = speed_along(nodes, target, ways.direction)
        f = self.driver.stopping(v, self.gap(nodes, target, ways.way))
        return accelerated(nodes, target, source, ways.direction, v, f, self.driver.time_constant)


@dataclass(frozen=True)
class SmoothStopping:
    """Coming to a line as to the end of a queue, without corners in the law; the source is the line."""

    needs: ClassVar[Needs] = (POSITION + VELOCITY, POSITION)
    driver: IntelligentDriver = settings_group(
        IntelligentDriver, "parameters of the driver; `hidden_vehicle_gap` is not used"
    )

    @property
    def time_constant(self) -> float:
        return self.driver.time_constant

    @property
    def alone(self) -> FloatArray:
        return np.array([1.0, 0.0, 0.0])

    def gap(self, nodes: NodeTable, target: IntArray, way: FloatArray) -> FloatArray:
        """Gap (E,), m, for ways (E,) from the centres to the line."""
        return np.maximum(way - nodes.length[target] / 2, LEAST_GAP)

    def given(self, nodes: NodeTable, target: IntArray, source: IntArray) -> FloatArray:
        """(E, 3) direction of the lane, and the gap less the distance to the line along it."""
        ways = approach(nodes, target, source)
        straight = np.einsum("ei,ei->e", nodes.position[source] - nodes.position[target], ways.direction)
        return np.column_stack([ways.direction, self.gap(nodes, target, ways.way) - straight])

    def accelerations(self, own: FloatArray, other: FloatArray, given: FloatArray) -> Accelerations:
        u = given[..., :2]
        v, s = (u * own[..., 2:]).sum(axis=-1), (u * (other - own)[..., :2]).sum(axis=-1) + given[..., 2]
        f = smooth_acceleration(self.driver, v, s, np.zeros_like(v))
        along = u[..., :, None] * u[..., None, :]
        by_gap = f.by_gap[..., None, None] * along
        by_own = np.concatenate([-by_gap, f.by_speed[..., None, None] * along], axis=-1)
        return Accelerations(f.value[..., None] * u, by_own, np.concatenate([by_gap, 0 * by_gap], axis=-1))


@dataclass(frozen=True)
class RedLight(Settings):
    """The first vehicle that comes to a closed stop line, and can stop, does."""

    interaction: Stopping | DriverStopping | SmoothStopping = settings_group(
        Stopping, "interaction function of the edges"
    )
    rate: NonNegative = setting(
        1.0,
        "strength of an edge of a vehicle that brakes for a line that is surely closed, 1/s; usual 0.5 to "
        "2; higher: brakes more surely",
    )
    max_distance: NonNegative = setting(
        100.0, "no edge from a line further away, m; usual 50 to 150; higher: vehicles brake from afar"
    )
    reaction_deceleration: NonNegative = setting(
        0.3, "needed deceleration at which drivers begin to react, m/s^2; usual 0.2 to 1; higher: they react later"
    )
    full_deceleration: Positive = setting(
        1.0, "needed deceleration from which they brake fully, m/s^2; usual 0.8 to 2; higher: they brake later"
    )
    max_deceleration: Positive = setting(
        4.5, "drivers who would have to brake harder do not stop, m/s^2; usual 3 to 6; higher: more vehicles stop"
    )
    classes: tuple[str, ...] = setting(VEHICLES, "classes of objects that take part")

    def pairs(self, nodes: NodeTable) -> Pairs:
        lines = np.flatnonzero(nodes.label == STOP_LINE)
        vehicles = np.flatnonzero(of_classes(nodes.label, self.classes))
        if len(lines) == 0 or len(vehicles) == 0 or nodes.closed is None:
            return Pairs(vehicles[:0], lines[:0], np.empty(0))
        target, source = np.repeat(vehicles, len(lines)), np.tile(lines, len(vehicles))
        near = np.hypot(*(nodes.position[target] - nodes.position[source]).T) <= self.max_distance
        target, source = target[near], source[near]
        ways = approach(nodes, target, source)
        v = speed_along(nodes, target, ways.direction)
        front = ways.way - nodes.length[target] / 2  # of the vehicle, before the line
        stops = np.flatnonzero(ways.comes & (front > 0) & (v**2 <= 2 * self.max_deceleration * front))
        preceded = _in_one_lane(source[stops], ways.crossing[stops]) & (ways.way[stops] < ways.way[stops, None])
        first = stops[~preceded.any(axis=1)]
        target, source, v = target[first], source[first], v[first]
        g = self.interaction.gap(nodes, target, ways.way[first])
        ramp = np.clip(
            (v**2 / (2 * g) - self.reaction_deceleration)
            / max(self.full_deceleration - self.reaction_deceleration, 1e-9),
            0.0,
            1.0,
        )
        return Pairs(target, source, self.rate * nodes.closed[source] * ramp)


def _in_one_lane(line: IntArray, crossing: FloatArray) -> BoolArray:
    """(E, E) which pairs are of one line and cross it within a metre or two of each other."""
    return np.asarray((line[:, None] == line) & (np.abs(crossing[:, None] - crossing) < SIDE_BY_SIDE))

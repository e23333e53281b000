"""Interactions with the map: stopping and starting at lights, keeping to lanes, passing cones.

Approaches of vehicles to stop lines: distances along a lane of the map or straight ahead, and the first in each lane.

A vehicle approaches a line along a lane of the map that crosses the line, or else straight along its heading, as where
a lane ends before the line.

A closed stop line brings the first vehicle to a halt, and through it the queue.

    dv_i/dt += rate u ( -v^2 / (2 g) ),    v = u.v_i,    g = u.(p_j - p_i) + bend - length_i / 2 - margin

is the constant deceleration that ends at the line: v the speed along the lane, g the remaining distance from the front
of the vehicle to `margin` before the line, `bend` the extra length of the lane over the straight line.
Linearised at the estimate (v0, g0):

    -v^2 / (2 g) ~ -v0^2 / (2 g0) - (v0 / g0) (v - v0) + v0^2 / (2 g0^2) (g - g0)

The rule: of the vehicles that come to a line, the first of each lane that can still stop, at

    rate = closed_j  ramp( v^2 / (2 g) from `reaction_deceleration` to `full_deceleration` )

since drivers do not brake for a line far away; a vehicle that would have to brake harder than `MAX_DECELERATION` goes
on. A slow one near the line comes to rest where it is: dv_i/dt += -rate v / `STOP_TIME`. Those behind follow by other
interactions. Alternatively the line is a stationary leader of the Intelligent Driver Model
(`saga_fg.model.nonlinear_interactions`): the vehicle brakes later and harder, and a slow one creeps up to the line.

An open stop line lets the first vehicle go, and through it the queue.

    dv_i/dt += `START_RATE` open_j ( speed - u.v_i ) u      where u.v_i < speed = `CROSSING_SPEED`

so that a standing vehicle starts with `START_RATE` speed, and its acceleration fades as it speeds up, as that of queues
does which a green light discharges.

Vehicles keep to the centre of their lane, and turn with it.

    dv_i/dt += rate n ( w n.t(s + w lag) - n.v_i - n.(p_i - f) / tau )

with s the place of vehicle i along the lane j, f the nearest point of the centre line, n the normal there, t the
direction of the lane, and w the vehicle's speed: its sideways velocity relaxes to that of the lane `lag` seconds ahead,
about what the relaxation lags behind (1 / rate), and its offset is made good within tau. f moves with the lane's own
state.

Cones and barriers form a temporary border of the lane, which pushes vehicles aside.

A driver looks ahead by L = `PREVIEW` * speed along their line (`saga_fg.model.edge_rules`), and drives to where he
will just clear it there. The two cones about a = L act, with the weights of linear interpolation w_k in their rates:

    dv_i/dt += rate w_k n ( ( n.(p_k - p_i) + m c ) / preview - n.v_i )         n across the vehicle's heading

    rate = `CONE_RATE` exp( -min(demand(L), 0)^2 / (2 `BAND`^2) )          0 for a vehicle well clear of the line

The setting `cones` of the rule `following` lets a vehicle that is pushed out of its lane follow, and lead, vehicles of
the lane beside it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from saga_fg.model.edge_rules import CLEARANCE, MIN_SPEED, Pairs, anticipated, cones_ahead
from saga_fg.model.interactions import (
    POSITION,
    VELOCITY,
    Needs,
    NodeTable,
    Triples,
    ahead_and_aside,
    unit,
    velocity_triples,
)
from saga_fg.model.nonlinear_interactions import (
    MIN_GAP,
    IntelligentDriver,
    Linearised,
    PathEnds,
    accelerated,
    speed_along,
)
from saga_fg.numerics import BoolArray, Columns, FloatArray, IntArray, direction_at, feet, of_classes, on_it, wrap_angle
from saga_fg.settings import NonNegative, Positive, Settings, setting, settings_group
from saga_fg.types import LANE, LIGHT, STOP_LINE, VEHICLES, LanesAcross

SIDE_BY_SIDE = 1.8  # m; vehicles that cross a line further apart are in different lanes
PAST = 2.0  # m; a vehicle waits at a line with its front up to this far beyond it
MAX_DISTANCE = 100.0  # m; lines further away do not concern a vehicle
CLEARED = 20.0  # m beyond a line within which vehicles still speed up
MAX_DECELERATION = 4.5  # m/s^2, usual 3 to 6; drivers who would have to brake harder do not stop
CROSSING_SPEED = 10.0  # m/s, at which vehicles of a discharged queue cross a line, usual 8 to 14
START_RATE = 0.2  # 1/s; by it the first acceleration is 2 m/s^2


@dataclass(frozen=True, eq=False)
class Approach(Columns):
    """E pairs of a vehicle and a stop line: whether it comes to it, the distance to it from the centre, along the
    lane, m, the direction of the lane at the vehicle (E, 2), and where it will cross the line, m left of its middle.
    """

    comes: BoolArray
    distance: FloatArray
    direction: FloatArray
    crossing: FloatArray


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
    distance, aside = ahead_and_aside(offset, u)  # of the line's middle
    ends = _ends(nodes, source)
    aligned = np.abs(wrap_angle(nodes.heading[target] - nodes.heading[source])) < math.pi / 4
    comes = (np.abs(aside) < np.hypot(*(ends[:, 0] - ends[:, 1]).T) / 2) & aligned & (distance > 0)
    found = Approach(comes, distance, u, -aside)
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
    found.distance[row], found.crossing[row] = lanes.s[crossed] - at.s, at.e - lanes.e[crossed]
    found.direction[row], found.comes[row] = at.direction, lanes.s[crossed] > at.s


@dataclass(frozen=True, eq=False)
class ComingVehicles(Columns):
    """E pairs of a vehicle that comes to a stop line and the line (rows of a `NodeTable`), with the approach, the speed
    along it, m/s, and the distance left to the front of the vehicle, m, negative where it is past the line."""

    target: IntArray
    source: IntArray
    approach: Approach
    speed: FloatArray
    front: FloatArray

    def first(self) -> ComingVehicles:
        """The first vehicle of each lane."""
        crossing, distance = self.approach.crossing, self.approach.distance
        one_lane = (self.source[:, None] == self.source) & (np.abs(crossing[:, None] - crossing) < SIDE_BY_SIDE)
        return self.select(~(one_lane & (distance < distance[:, None])).any(axis=1))


def _ends(nodes: NodeTable, source: IntArray) -> FloatArray:
    """Left and right ends (E, 2, 2) of lines about their middles, m."""
    lines, row = np.unique(source, return_inverse=True)
    return np.array([nodes.outline[j] for j in lines.tolist()]).reshape(-1, 2, 2)[row]


def _near(nodes: NodeTable, max_distance: float) -> tuple[IntArray, IntArray]:
    """Vehicles and lines within some distance of each other (E,)."""
    lines = np.flatnonzero(nodes.label == STOP_LINE)
    vehicles = np.flatnonzero(of_classes(nodes.label, VEHICLES))
    target, source = np.repeat(vehicles, len(lines)), np.tile(lines, len(vehicles))
    near = np.hypot(*(nodes.position[target] - nodes.position[source]).T) <= max_distance
    return target[near], source[near]


def coming_vehicles(nodes: NodeTable) -> ComingVehicles:
    """All vehicles that come to a line within `MAX_DISTANCE`; those that wait a little past it among them."""
    if "coming" not in nodes.derived:
        target, source = _near(nodes, MAX_DISTANCE)
        near = approach(nodes, target, source)
        speed = np.maximum(np.einsum("ei,ei->e", nodes.velocity[target], near.direction), 0.0)
        front = near.distance - nodes.length[target] / 2
        found = ComingVehicles(target, source, near, speed, front)
        nodes.derived["coming"] = found.select(near.comes & (front > -PAST))
    coming: ComingVehicles = nodes.derived["coming"]
    return coming


def passed_vehicles(nodes: NodeTable) -> ComingVehicles:
    """All vehicles that have crossed a line straight on and are within `CLEARED` of it."""
    target, source = _near(nodes, CLEARED)
    beyond, across = nodes.position[target] - nodes.position[source], unit(nodes.heading[source])
    ends = _ends(nodes, source)
    passed, aside = ahead_and_aside(beyond, across)
    aligned = np.abs(wrap_angle(nodes.heading[target] - nodes.heading[source])) < math.pi / 4
    inside = (passed > 0) & aligned & (np.abs(aside) < np.hypot(*(ends[:, 0] - ends[:, 1]).T) / 2)
    u = unit(nodes.heading[target])
    speed = np.maximum(np.einsum("ei,ei->e", nodes.velocity[target], u), 0.0)
    front = -passed - nodes.length[target] / 2
    return ComingVehicles(target, source, Approach(inside, -passed, u, aside), speed, front).select(inside)


STOP_TIME = 1.0  # s, time constant with which the last of the speed fades
HALTING_SPEED = 2.0  # m/s; slower vehicles near a closed line come to rest where they are
HALTING_GAP = 10.0  # m from the front of the vehicle to the line


@dataclass(frozen=True)
class Stopping(Settings):
    """Even deceleration to a halt before a line; the source is the line."""

    needs: ClassVar[Needs] = (POSITION + VELOCITY, POSITION)
    margin: NonNegative = setting(
        3.0,
        "distance left between the front of a stopped vehicle and the line, m; usual 1 to 5; higher: stops earlier",
    )

    def gap(self, nodes: NodeTable, target: IntArray, distance: FloatArray) -> FloatArray:
        """g (E,), m, for distances (E,) from the centres to the line."""
        return np.maximum(distance - nodes.length[target] / 2 - self.margin, MIN_GAP)

    def law(self, v: FloatArray, g: FloatArray) -> Linearised:
        """The deceleration (E,) at speeds and remaining distances g (E,)."""
        g = np.maximum(g, v**2 / (2 * MAX_DECELERATION))
        none = np.zeros_like(v)
        even = Linearised(-(v**2) / (2 * g), -v / g, v**2 / (2 * g**2), none)
        return Linearised(-v / STOP_TIME, none - 1 / STOP_TIME, none, none).where(halting(v, g + self.margin), even)

    def triples(self, nodes: NodeTable, target: IntArray, source: IntArray) -> Triples:
        return _stopping(self, nodes, target, source)


@dataclass(frozen=True)
class DriverStopping:
    """Coming to a line as to the end of a queue; the source is the line."""

    needs: ClassVar[Needs] = (POSITION + VELOCITY, POSITION)
    driver: IntelligentDriver = settings_group(
        IntelligentDriver, "parameters of the driver; its standstill gap is to the line"
    )

    def gap(self, nodes: NodeTable, target: IntArray, distance: FloatArray) -> FloatArray:
        """Gap (E,), m, for distances (E,) from the centres to the line."""
        return np.maximum(distance - nodes.length[target] / 2, MIN_GAP)

    def law(self, v: FloatArray, g: FloatArray) -> Linearised:
        """The acceleration (E,) at speeds and gaps g (E,)."""
        return self.driver.stopping(v, g)

    def triples(self, nodes: NodeTable, target: IntArray, source: IntArray) -> Triples:
        return _stopping(self, nodes, target, source)


def _stopping(law: Stopping | DriverStopping, nodes: NodeTable, target: IntArray, source: IntArray) -> Triples:
    """The triples of a law before lines."""
    near = approach(nodes, target, source)
    v = speed_along(nodes, target, near.direction)
    f = law.law(v, law.gap(nodes, target, near.distance))
    return accelerated(nodes, target, source, PathEnds(near.direction, near.direction, v), f)


@dataclass(frozen=True)
class RedLight(Settings):
    """The first vehicle that comes to a closed stop line, and can stop, does."""

    map_classes: ClassVar[tuple[str, ...]] = (LIGHT, STOP_LINE)
    classes: ClassVar[tuple[str, ...]] = VEHICLES
    interaction: Stopping | DriverStopping = settings_group(Stopping, "interaction function of the edges")
    reaction_deceleration: NonNegative = setting(
        0.3, "needed deceleration at which drivers begin to react, m/s^2; usual 0.2 to 1; higher: they react later"
    )
    full_deceleration: Positive = setting(
        1.0, "needed deceleration from which they brake fully, m/s^2; usual 0.8 to 2; higher: they brake later"
    )

    def able(self, coming: ComingVehicles) -> ComingVehicles:
        """Coming vehicles that can stop before the line, or halt at it."""
        can = (coming.front > 0) & (coming.speed**2 <= 2 * MAX_DECELERATION * coming.front)
        return coming.select(can | halting(coming.speed, coming.front))

    def brakes(self, nodes: NodeTable, coming: ComingVehicles) -> tuple[FloatArray, FloatArray]:
        """The probability that each driver brakes for a closed line (E,), and the acceleration then (E,), m/s^2."""
        g = self.interaction.gap(nodes, coming.target, coming.approach.distance)
        needed = coming.speed**2 / (2 * g) - self.reaction_deceleration
        ramp = np.clip(needed / max(self.full_deceleration - self.reaction_deceleration, 1e-9), 0.0, 1.0)
        ramp = np.where(halting(coming.speed, coming.front), 1.0, ramp)
        return ramp, self.interaction.law(coming.speed, g).value

    def pairs(self, nodes: NodeTable) -> Pairs:
        first = self.able(coming_vehicles(nodes)).first()
        return Pairs(first.target, first.source, nodes.closed[first.source] * self.brakes(nodes, first)[0])


def halting(speed: FloatArray, front: FloatArray) -> BoolArray:
    """Mask of the vehicles that come to rest before the line, by their speeds, m/s, and distances from it, m."""
    return np.asarray((speed < HALTING_SPEED) & (front < HALTING_GAP))


@dataclass(frozen=True)
class Starting:
    """Relaxation to the speed of a queue that is discharged; the source is the line."""

    needs: ClassVar[Needs] = (VELOCITY, ())

    def triples(self, nodes: NodeTable, target: IntArray, source: IntArray) -> Triples:
        u = approach(nodes, target, source).direction
        return velocity_triples(
            nodes, target, source, by_velocity=-u[:, :, None] * u[:, None, :], constant=CROSSING_SPEED * u
        )


@dataclass(frozen=True)
class GreenLight:
    """The first vehicle that comes to an open stop line, or has just crossed it, speeds up."""

    map_classes: ClassVar[tuple[str, ...]] = (LIGHT, STOP_LINE)
    classes: ClassVar[tuple[str, ...]] = VEHICLES
    interaction: ClassVar[Starting] = Starting()

    def acceleration(self, speed: FloatArray) -> FloatArray:
        """Accelerations (E,) of vehicles of these speeds before a line that is surely open, m/s^2."""
        return START_RATE * np.maximum(CROSSING_SPEED - speed, 0.0)

    def pairs(self, nodes: NodeTable) -> Pairs:
        found = []
        for first in (coming_vehicles(nodes).first(), passed_vehicles(nodes).first()):
            slow = first.select(first.speed < CROSSING_SPEED)
            found.append(Pairs(slow.target, slow.source, START_RATE * nodes.open[slow.source]))
        return Pairs(*(np.concatenate(column) for column in zip(*found, strict=True)))


PUSHED = 0.5  # m aside, from which cones decide and no longer the lane
LATERAL_SPEED_SCALE = 0.8  # sigma of the kernel on the speed across the lane, m/s
OFFSET_TIME = 3.0  # tau: time constant with which an offset from the centre line fades, s
LAG = 0.5  # s, by which vehicles look ahead along the lane
LANE_RATE = 2.0  # 1/s, of an edge from a lane
PREVIEW = 1.5  # s, by which drivers look ahead along a line of cones
CONE_RATE = 3.0  # 1/s, of an edge of a vehicle that has to move aside; usual 1 to 5
BAND = 0.5  # m, sigma of the kernel on the distance to where a line is just cleared


@dataclass(frozen=True)
class KeepLane:
    """Attraction to the centre line of a lane and to its direction; the source is the lane."""

    needs: ClassVar[Needs] = (POSITION + VELOCITY, POSITION)

    def triples(self, nodes: NodeTable, target: IntArray, source: IntArray) -> Triples:
        across, constant = np.zeros((len(target), 2, 2)), np.zeros((len(target), 2))
        for lane in np.unique(source).tolist():
            rows = np.flatnonzero(source == lane)
            centre, mine = nodes.outline[lane], target[rows]
            at = feet(centre, nodes.position[mine])
            n = np.stack([-at.direction[:, 1], at.direction[:, 0]], axis=-1)
            speed = np.maximum(np.einsum("ei,ei->e", nodes.velocity[mine], at.direction), 0.0)
            ahead = direction_at(centre, at.s + speed * LAG)
            across[rows] = n[:, :, None] * n[:, None, :]
            foot = np.einsum("ei,ei->e", at.point - nodes.position[lane], n)
            sideways = speed * np.einsum("ei,ei->e", ahead, n) + foot / OFFSET_TIME
            constant[rows] = n * sideways[:, None]
        pull = across / OFFSET_TIME
        return velocity_triples(nodes, target, source, -pull, -across, pull, constant=constant)


@dataclass(frozen=True)
class InLane(Settings):
    """A vehicle that drives along a lane of the map, within its borders, keeps it."""

    map_classes: ClassVar[tuple[str, ...]] = (LANE,)
    interaction: ClassVar[KeepLane] = KeepLane()
    classes: ClassVar[tuple[str, ...]] = VEHICLES
    cones: bool = setting(False, "true: vehicles that cones push out of the lane do not keep it; false: ignore cones")

    def pairs(self, nodes: NodeTable) -> Pairs:
        able = of_classes(nodes.label, self.classes)
        if self.cones:
            aside = anticipated(nodes, self.classes) - nodes.position
            able &= np.hypot(*aside.T) < PUSHED
        vehicles = np.flatnonzero(able)
        targets, sources, rates = [vehicles[:0]], [vehicles[:0]], [np.empty(0)]
        u = unit(nodes.heading[vehicles])
        for lane in np.flatnonzero(nodes.label == LANE).tolist() if len(vehicles) else ():
            at = feet(nodes.outline[lane], nodes.position[vehicles])
            along = np.einsum("ei,ei->e", at.direction, u)
            inside = (np.abs(at.e) <= nodes.width[lane] / 2) & (along > 0) & on_it(nodes.outline[lane], at.s)
            drift = ahead_and_aside(nodes.velocity[vehicles], at.direction)[1]
            mine = vehicles[inside]
            targets.append(mine)
            sources.append(np.full(len(mine), lane, dtype=np.int64))
            rates.append(LANE_RATE * np.exp(-((drift[inside] / LATERAL_SPEED_SCALE) ** 2) / 2))
        return Pairs(np.concatenate(targets), np.concatenate(sources), np.concatenate(rates))


@dataclass(frozen=True)
class PassCones:
    """Driving to where the line of cones is just cleared; the source is a cone."""

    needs: ClassVar[Needs] = (POSITION + VELOCITY, POSITION)

    def triples(self, nodes: NodeTable, target: IntArray, source: IntArray) -> Triples:
        vehicles, number = np.unique(target, return_inverse=True)
        side = cones_ahead(nodes, vehicles).side[number]
        u = unit(nodes.heading[target])
        n = np.stack([-u[:, 1], u[:, 0]], axis=-1)
        across = n[:, :, None] * n[:, None, :]
        gain = 1 / PREVIEW  # w / L
        constant = gain * CLEARANCE * side[:, None] * n
        return velocity_triples(nodes, target, source, -gain * across, -across, gain * across, constant=constant)


@dataclass(frozen=True)
class ConeLine:
    """Vehicles ahead of which cones form a line pass it on its free side."""

    map_classes: ClassVar[tuple[str, ...]] = ()
    interaction: ClassVar[PassCones] = PassCones()
    classes: ClassVar[tuple[str, ...]] = VEHICLES

    def pairs(self, nodes: NodeTable) -> Pairs:
        vehicles = np.flatnonzero(of_classes(nodes.label, self.classes))
        line = cones_ahead(nodes, vehicles)
        distance = PREVIEW * line.speed
        before = (line.known & (line.ahead <= distance[:, None])).sum(axis=1)  # cones up to where the driver looks
        count = line.known.sum(axis=1)
        # beyond the last cone the line goes on as it ends; before the first there is none
        rows = np.flatnonzero((before > 0) & (line.speed > MIN_SPEED))
        near, far = before[rows] - 1, np.minimum(before[rows], count[rows] - 1)
        gap = np.maximum(line.ahead[rows, far] - line.ahead[rows, near], 1e-9)
        share = np.where(far > near, (distance[rows] - line.ahead[rows, near]) / gap, 0.0)
        demand = (1 - share) * line.demand[rows, near] + share * line.demand[rows, far]
        rate = CONE_RATE * np.exp(-((np.minimum(demand, 0.0) / BAND) ** 2) / 2)
        apart = far > near
        return Pairs(
            vehicles[np.concatenate([rows, rows[apart]])],
            np.concatenate([line.row[rows, near], line.row[rows[apart], far[apart]]]),
            np.concatenate([rate * (1 - share), (rate * share)[apart]]),
        )

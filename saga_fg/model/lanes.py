"""Lane keeping, and cones and barriers as temporary borders of a lane.

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

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from saga_fg.model.edge_rules import CLEARANCE, CONES, MIN_SPEED, VEHICLES, Pairs, anticipated, cones_ahead
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
from saga_fg.numerics.arrays import IntArray, of_classes
from saga_fg.numerics.geometry import direction_at, feet, on_it
from saga_fg.settings import Settings, setting
from saga_fg.types.road_map import LANE

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
        none = Pairs(vehicles[:0], vehicles[:0], np.empty(0))
        if len(vehicles) == 0 or not of_classes(nodes.label, CONES).any():
            return none
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

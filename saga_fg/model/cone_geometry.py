r"""The line that cones and barriers form ahead of a vehicle.

In the frame of the vehicle (a ahead, y to the left), the cones near its path, in order of a, are a line y(a). Its side
is that of the nearest cone, and the vehicle has to pass on the other one: with m = +1 if that is the left, else -1, and
the distance c that drivers keep between cones and the middle of their vehicle,

    demand(a) = m y(a) + c         how far to the side the vehicle has to be by a; above 0: it is pushed
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from saga_fg.model.interactions import NodeTable, unit
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, of_classes
from saga_fg.settings import Positive, Settings, setting

CONES = ("traffic_cone", "barrier")
MIN_SPEED = 1.0  # m/s; slower vehicles are not pushed
BESIDE = 3.0  # m behind the middle of a vehicle, up to which a cone is still beside it
CORRIDOR = 6.0  # cones further aside are ignored, m
REACH = 45.0  # cones further ahead are ignored, m


@dataclass(frozen=True)
class ConeGeometry(Settings):
    """Range of cones that concern a vehicle, and the clearance to them."""

    clearance: Positive = setting(
        1.75, "c: distance that drivers keep between cones and the middle of their vehicle, m; usual 1.5 to 2"
    )
    preview: Positive = setting(
        1.5, "time by which drivers look ahead along the line, s; usual 0.5 to 3; higher: vehicles move aside earlier"
    )
    classes: tuple[str, ...] = setting(CONES, "classes of objects that form a line")


class ConesAhead(NamedTuple):
    """The cones ahead of n vehicles, nearest first: rows (n, m) of nodes; ahead, demand (n, m), m; known (n, m) whether
    there is one; side (n,) m; speed (n,) along the heading, m/s."""

    row: IntArray
    ahead: FloatArray
    demand: FloatArray
    known: BoolArray
    side: FloatArray
    speed: FloatArray


def cones_ahead(nodes: NodeTable, vehicles: IntArray, geometry: ConeGeometry) -> ConesAhead:
    """The cones ahead of `vehicles` (n,), rows of `nodes`."""
    cones = np.flatnonzero(of_classes(nodes.label, geometry.classes))
    u = unit(nodes.heading[vehicles])
    offset = nodes.position[cones] - nodes.position[vehicles, None]
    ahead = np.einsum("nmi,ni->nm", offset, u)
    left = u[:, None, 0] * offset[..., 1] - u[:, None, 1] * offset[..., 0]
    known = (ahead > -BESIDE) & (ahead < REACH) & (np.abs(left) < CORRIDOR)
    order = np.argsort(np.where(known, ahead, np.inf), axis=1)
    ahead, left, known = (np.take_along_axis(x, order, axis=1) for x in (ahead, left, known))
    first = left[:, 0] if len(cones) else np.zeros(len(vehicles))
    side = np.where(first < 0, 1.0, -1.0)
    demand = side[:, None] * left + geometry.clearance
    speed = np.einsum("ni,ni->n", nodes.velocity[vehicles], u)
    return ConesAhead(cones[order], ahead, demand, known, side, speed)


def anticipated(nodes: NodeTable, classes: tuple[str, ...], geometry: ConeGeometry) -> FloatArray:
    """Positions (n, 2) of all nodes, those of vehicles moved aside as far as the cones before them will push them."""
    position = nodes.position.copy()
    vehicles = np.flatnonzero(of_classes(nodes.label, classes))
    if len(vehicles) == 0 or not of_classes(nodes.label, geometry.classes).any():
        return position
    line = cones_ahead(nodes, vehicles, geometry)
    pushed = np.where(line.known & (line.ahead > 0), line.demand, 0.0).max(axis=1, initial=0.0)
    pushed = np.where(line.speed > MIN_SPEED, pushed, 0.0)
    u = unit(nodes.heading[vehicles])
    position[vehicles] += (line.side * pushed)[:, None] * np.stack([-u[:, 1], u[:, 0]], axis=-1)
    return position

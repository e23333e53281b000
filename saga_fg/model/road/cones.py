r"""Cones and barriers form a temporary border of the lane, which pushes vehicles aside.

A driver looks ahead by L = preview * speed along their line (`saga_fg.model.cone_geometry`), and drives to where he
will just clear it there. The two cones about a = L act, with the weights of linear interpolation w_k in their rates:

    dv_i/dt += rate w_k n ( ( n.(p_k - p_i) + m c ) / preview - n.v_i )         n across the vehicle's heading

    rate = rate exp( -min(demand(L), 0)^2 / (2 band^2) )          0 for a vehicle well clear of the line

The setting `cones` of the rule `following` lets a vehicle that is pushed out of its lane follow, and lead, vehicles of
the lane beside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from saga_fg.model.cone_geometry import MIN_SPEED, ConeGeometry, cones_ahead
from saga_fg.model.edge_rules import VEHICLES, Pairs
from saga_fg.model.interactions import POSITION, VELOCITY, Needs, NodeTable, Triples, unit, velocity_triples
from saga_fg.numerics.arrays import IntArray, of_classes
from saga_fg.settings import (
    NonNegative,
    PositiveOrInf,
    setting,
    settings_group,
)


@dataclass(frozen=True)
class PassCones:
    """Driving to where the line of cones is just cleared; the source is a cone."""

    needs: ClassVar[Needs] = (POSITION + VELOCITY, POSITION)
    geometry: ConeGeometry

    def triples(self, nodes: NodeTable, target: IntArray, source: IntArray) -> Triples:
        vehicles, number = np.unique(target, return_inverse=True)
        side = cones_ahead(nodes, vehicles, self.geometry).side[number]
        u = unit(nodes.heading[target])
        n = np.stack([-u[:, 1], u[:, 0]], axis=-1)
        across = n[:, :, None] * n[:, None, :]
        gain = 1 / self.geometry.preview  # w / L
        constant = gain * self.geometry.clearance * side[:, None] * n
        return velocity_triples(nodes, target, source, -gain * across, -across, gain * across, constant=constant)


@dataclass(frozen=True)
class ConeLine:
    """Vehicles ahead of which cones form a line pass it on its free side."""

    cones: ConeGeometry = settings_group(ConeGeometry, "which cones concern a vehicle, and how it passes them")
    map_classes: ClassVar[tuple[str, ...]] = ()
    rate: NonNegative = setting(
        3.0,
        "strength of an edge of a vehicle that has to move aside, 1/s; usual 1 to 5; higher: pushed aside more firmly",
    )
    clearance_scale: PositiveOrInf = setting(
        0.5,
        "sigma of the kernel on the distance to where the line is just cleared, m; usual 0.3 to 1; higher: "
        "vehicles that clear it are pushed, too",
    )
    vehicles: tuple[str, ...] = setting(VEHICLES, "classes that move aside")

    @property
    def interaction(self) -> PassCones:
        """The interaction function of the edges."""
        return PassCones(self.cones)

    def pairs(self, nodes: NodeTable) -> Pairs:
        vehicles = np.flatnonzero(of_classes(nodes.label, self.vehicles))
        none = Pairs(vehicles[:0], vehicles[:0], np.empty(0))
        if len(vehicles) == 0 or not of_classes(nodes.label, self.cones.classes).any():
            return none
        line = cones_ahead(nodes, vehicles, self.cones)
        distance = self.cones.preview * line.speed
        before = (line.known & (line.ahead <= distance[:, None])).sum(axis=1)  # cones up to where the driver looks
        count = line.known.sum(axis=1)
        # beyond the last cone the line goes on as it ends; before the first there is none
        rows = np.flatnonzero((before > 0) & (line.speed > MIN_SPEED))
        near, far = before[rows] - 1, np.minimum(before[rows], count[rows] - 1)
        gap = np.maximum(line.ahead[rows, far] - line.ahead[rows, near], 1e-9)
        share = np.where(far > near, (distance[rows] - line.ahead[rows, near]) / gap, 0.0)
        demand = (1 - share) * line.demand[rows, near] + share * line.demand[rows, far]
        rate = self.rate * np.exp(-((np.minimum(demand, 0.0) / self.clearance_scale) ** 2) / 2)
        apart = far > near
        return Pairs(
            vehicles[np.concatenate([rows, rows[apart]])],
            np.concatenate([line.row[rows, near], line.row[rows[apart], far[apart]]]),
            np.concatenate([rate * (1 - share), (rate * share)[apart]]),
        )

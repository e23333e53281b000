"""An open stop line lets the first vehicle go, and through it the queue.

    dv_i/dt += rate open_j ( speed - u.v_i ) u      where u.v_i < speed

so that a standing vehicle starts with rate * speed, and its acceleration fades as it speeds up, as that of queues does
which a green light discharges.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from saga_fg.model.edge_rules import VEHICLES, Pairs
from saga_fg.model.interactions import VELOCITY, Needs, NodeTable, Triples, velocity_triples
from saga_fg.model.road.stop_lines import approach, coming_vehicles, passed_vehicles
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.settings import NonNegative, Positive, Settings, setting, settings_group
from saga_fg.types.road_map import LIGHT, STOP_LINE

CLEARED = 20.0  # m beyond a line within which vehicles still speed up


@dataclass(frozen=True)
class Starting(Settings):
    """Relaxation to the speed of a queue that is discharged; the source is the line."""

    needs: ClassVar[Needs] = (VELOCITY, ())
    speed: Positive = setting(
        10.0, "speed at which vehicles cross an open line, m/s; usual 8 to 14; higher: they accelerate for longer"
    )

    def triples(self, nodes: NodeTable, target: IntArray, source: IntArray) -> Triples:
        u = approach(nodes, target, source).direction
        return velocity_triples(
            nodes, target, source, by_velocity=-u[:, :, None] * u[:, None, :], constant=self.speed * u
        )


@dataclass(frozen=True)
class GreenLight(Settings):
    """The first vehicle that comes to an open stop line, or has just crossed it, speeds up."""

    map_classes: ClassVar[tuple[str, ...]] = (LIGHT, STOP_LINE)
    interaction: Starting = settings_group(Starting, "interaction function of the edges")
    rate: NonNegative = setting(
        0.2,
        "strength of an edge from a line that is surely open, 1/s: the first acceleration is this times the speed; "
        "usual 0.1 to 0.3; higher: vehicles start faster",
    )
    max_distance: NonNegative = setting(
        100.0, "no edge from a line further away, m; usual 20 to 150; higher: slow vehicles speed up from afar"
    )
    classes: tuple[str, ...] = setting(VEHICLES, "classes of objects that take part")

    def acceleration(self, speed: FloatArray) -> FloatArray:
        """Accelerations (E,) of vehicles of these speeds before a line that is surely open, m/s^2."""
        return self.rate * np.maximum(self.interaction.speed - speed, 0.0)

    def pairs(self, nodes: NodeTable) -> Pairs:
        coming = coming_vehicles(nodes, self.classes, self.max_distance)
        found = []
        for first in (coming.first(), passed_vehicles(nodes, self.classes, CLEARED).first()):
            slow = first.select(first.speed < self.interaction.speed)
            weight = np.zeros(len(slow.source)) if nodes.open is None else nodes.open[slow.source]
            found.append(Pairs(slow.target, slow.source, self.rate * weight))
        return Pairs(*(np.concatenate(column) for column in zip(*found, strict=True)))

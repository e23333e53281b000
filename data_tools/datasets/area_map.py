"""A map to draw below tracks: areas, and lines of lanes, near the path of the vehicle."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.dataset import Scene

Kind = Literal["drivable", "walkway", "crossing"]
REACH = 120.0
"""Distance to the path of the vehicle, along x and y, up to which a map is kept, m."""


@dataclass(frozen=True, eq=False)
class AreaMap:
    """Areas and lines in world coordinates, m.

    areas  kind, and rings (N, 2): where rings of an area overlap, there is a hole
    lines  (N, 2) borders of lanes
    """

    areas: Sequence[tuple[Kind, Sequence[FloatArray]]]
    lines: Sequence[FloatArray]

    @classmethod
    def around(
        cls, scene: Scene, areas: Iterable[tuple[Kind, Sequence[FloatArray]]], lines: Iterable[FloatArray]
    ) -> Self:
        """Return the parts near the path of a scene, cut where they leave its surroundings."""
        path = scene.world_T_ego[:, :2, 3]
        low, high = path.min(axis=0) - REACH, path.max(axis=0) + REACH
        cut = ((kind, [piece for ring in rings if len(piece := clipped(ring, low, high))]) for kind, rings in areas)
        near = [line for line in lines if ((line >= low) & (line <= high)).all(axis=1).any()]
        return cls([area for area in cut if area[1]], near)


def clipped(ring: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Return the part of a ring (N, 2) inside a rectangle, as a ring, empty for none (Sutherland and Hodgman, 1974)."""
    for axis in (0, 1):
        for sign, bound in ((1.0, high[axis]), (-1.0, -low[axis])):
            if not len(ring):
                return ring
            room = bound - sign * ring[:, axis]  # negative outside
            nxt, room_next = np.roll(ring, -1, axis=0), np.roll(room, -1)
            inside = room >= 0
            crosses = inside != (room_next >= 0)
            with np.errstate(divide="ignore", invalid="ignore"):
                cut = ring + (room / (room - room_next))[:, None] * (nxt - ring)
            points = np.stack([ring, cut], axis=1)
            ring = points[np.stack([inside, crosses], axis=1)]
    return ring

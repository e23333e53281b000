"""The lanes of a map that cross its stop lines: their geometry, found once, for places of any number of vehicles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.polyline import Feet, Polylines
from saga_fg.types.road_map import Lane, StopLine


class InLane(NamedTuple):
    """Vehicles in lanes, m pairs: vehicle (m,) and lane (m,), and the feet of the vehicles on the centres."""

    vehicle: IntArray
    lane: IntArray
    feet: Feet


@dataclass(frozen=True, eq=False)
class LanesAcross:
    """P pairs of a stop line and one of L lanes that crosses it.

    centre, width       of the lanes: polylines in world coordinates, (L,) m
    low, high           (L, 2) corners of the boxes about the lanes, m
    line, lane          (P,) of the pairs, in the order of the lines
    s, e, direction     (P,), (P,), (P, 2): where the middle of the line is along the lane and to its left, m, and the
                        direction of the lane there
    origin              (2,) of the coordinates in which vehicles are placed, world, m
    """

    centre: Polylines
    width: FloatArray
    low: FloatArray
    high: FloatArray
    line: IntArray
    lane: IntArray
    s: FloatArray
    e: FloatArray
    direction: FloatArray
    origin: FloatArray

    @classmethod
    def of(cls, lanes: Sequence[Lane], lines: Sequence[StopLine]) -> Self:
        """A lane crosses a line in its direction of travel, between its ends; straight on before and after it."""
        ends = np.array([line.ends for line in lines]).reshape(-1, 2, 2)
        heading = np.array([line.heading for line in lines])
        line, lane = np.divmod(np.arange(len(lines) * len(lanes)), max(len(lanes), 1))
        centre = Polylines.of([np.array(each.centre) for each in lanes])
        at = centre.feet(lane, ends.mean(axis=1)[line])
        travel = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        half = np.hypot(*(ends[:, 0] - ends[:, 1]).T) / 2
        crosses = (np.einsum("pi,pi->p", at.direction, travel[line]) > 0) & (np.abs(at.e) <= half[line])
        at, line = at.select(crosses), line[crosses]
        kept, lane = np.unique(lane[crosses], return_inverse=True)  # without lanes that cross no line
        points = [np.array(lanes[k].centre) for k in kept.tolist()]
        width = np.array([lanes[k].width for k in kept.tolist()])
        box = np.array([[each.min(axis=0), each.max(axis=0)] for each in points]).reshape(-1, 2, 2)
        low, high = box[:, 0] - width[:, None], box[:, 1] + width[:, None]
        return cls(Polylines.of(points), width, low, high, line, lane, at.s, at.e, at.direction, np.zeros(2))

    def placed(self, origin: FloatArray, moved: FloatArray, rows: IntArray) -> LanesAcross:
        """The lanes for vehicles in coordinates about `origin` (2,), with the lines moved by `moved` (lines, 2), m, and
        named `rows` (lines,), increasing."""
        by, (x, y) = moved[self.line], self.direction.T
        along = np.einsum("pi,pi->p", self.direction, by)
        return replace(
            self, origin=origin, line=rows[self.line], s=self.s + along, e=self.e + x * by[:, 1] - y * by[:, 0]
        )

    def of_nodes(self, rows: IntArray) -> LanesAcross:
        """The lanes across the lines that are among the nodes `rows` (k,), ascending, which are counted from 0 then."""
        place = np.searchsorted(rows, self.line).clip(max=max(len(rows) - 1, 0))
        kept = rows[place] == self.line if len(rows) else np.zeros(len(self.line), dtype=np.bool_)
        line, lane, s, e = place[kept], self.lane[kept], self.s[kept], self.e[kept]
        return replace(self, line=line, lane=lane, s=s, e=e, direction=self.direction[kept])

    def inside(self, position: FloatArray, facing: FloatArray) -> InLane:
        """Vehicles at `position` (V, 2), m, in lanes that lead where they are `facing`, unit vectors (V, 2)."""
        place = position + self.origin
        near = ((place[:, None] >= self.low) & (place[:, None] <= self.high)).all(axis=-1)
        vehicle, lane = np.nonzero(near)
        at = self.centre.feet(lane, place[vehicle])
        inside = (np.abs(at.e) <= self.width[lane] / 2) & (at.s >= 0) & (at.s <= self.centre.length[lane])
        inside &= np.einsum("mi,mi->m", at.direction, facing[vehicle]) > 0
        return InLane(vehicle[inside], lane[inside], at.select(inside))

    def crossings(self, line: IntArray) -> tuple[IntArray, IntArray]:
        """Rows of `line` (E,) and the pairs of a line and a lane that each has."""
        first, end = np.searchsorted(self.line, line), np.searchsorted(self.line, line, side="right")
        count = end - first
        row = np.repeat(np.arange(len(line)), count)
        return row, np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count) + first[row]

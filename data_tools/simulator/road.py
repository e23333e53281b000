"""Roads and lanes of the simulated world.

Roads: a smooth centre line, and coordinates along and across it.

A position is given by s, the distance along the centre line, and d, the distance to its left (Frenet coordinates):

    p(s, d) = c(s) + d n(s),      c'(s) = t(s),      heading'(s) = kappa(s),      dp/ds at constant d = (1 - kappa d) t

The curvature kappa is a sum of smooth bumps; heading and centre line are its first and second integral on a fine grid.

Lanes along the centre line of a road, each with a direction of travel; one of them may join and end.

Along a lane, distance is measured in its direction of travel: road s for forward lanes, length - s for oncoming ones.
An ending lane that starts `approach` m outside the road is an on-ramp; with approach 0 it is a lane drop. It may also
be closed by cones, which move its traffic into the adjacent lane over the last `taper` m.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray

GRID = 0.5  # m


@dataclass(frozen=True, eq=False)
class Road:
    """A centre line sampled every `GRID` m from s = 0, in world coordinates.

    point (G, 2) m, heading (G,) rad (not wrapped), curvature (G,) 1/m.
    """

    point: FloatArray
    heading: FloatArray
    curvature: FloatArray

    @property
    def length(self) -> float:
        return GRID * (len(self.heading) - 1)

    def curvature_at(self, s: FloatArray) -> FloatArray:
        """Curvature, 1/m, at s of any shape; the road runs on straight beyond its ends."""
        position = np.clip(s / GRID, 0, len(self.curvature) - 1)
        return np.asarray(self.curvature[position.astype(np.int64)])

    def heading_at(self, s: FloatArray) -> FloatArray:
        """Direction of the centre line, rad, at s of any shape."""
        return np.interp(s, GRID * np.arange(len(self.heading)), self.heading)

    def position(self, s: FloatArray, d: FloatArray) -> FloatArray:
        """World coordinates (..., 2) of positions s, d (...), m."""
        grid = GRID * np.arange(len(self.heading))
        inside = np.clip(s, 0, self.length)
        heading = self.heading_at(inside)
        tangent = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        normal = np.stack([-tangent[..., 1], tangent[..., 0]], axis=-1)
        centre = np.stack([np.interp(inside, grid, self.point[:, axis]) for axis in (0, 1)], axis=-1)
        return np.asarray(centre + (s - inside)[..., None] * tangent + d[..., None] * normal)


def curved_road(length: float, bends: list[tuple[float, float, float]], start: FloatArray, heading: float) -> Road:
    """A road of `length` m from `start` (2,) in direction `heading`, rad.

    Each bend is (middle, m along the road; total turn, rad, left positive; length, m): a curvature bump of the shape
    1 + cos, whose peak is 2 turn / length.
    """
    s = GRID * np.arange(round(length / GRID) + 1)
    curvature = np.zeros_like(s)
    for middle, turn, extent in bends:
        phase = np.clip((s - middle) / extent, -0.5, 0.5)
        curvature += turn / extent * (1 + np.cos(2 * np.pi * phase))
    direction = heading + _integral(curvature)
    point = start + np.stack([_integral(np.cos(direction)), _integral(np.sin(direction))], axis=-1)
    return Road(point, direction, curvature)


def _integral(values: FloatArray) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2)]) * GRID


SPAN = 1.0e6  # m, longer than any road


def smooth_step(share: FloatArray) -> FloatArray:
    """6 x^5 - 15 x^4 + 10 x^3, clipped to [0, 1]: from 0 to 1 with vanishing slope and curvature at both ends."""
    x = np.clip(share, 0.0, 1.0)
    return np.asarray(x**3 * (x * (6 * x - 15) + 10))


def smooth_step_slope(share: FloatArray) -> FloatArray:
    """Derivative of `smooth_step`."""
    x = np.clip(share, 0.0, 1.0)
    return np.asarray(30 * x**2 * (1 - x) ** 2)


@dataclass(frozen=True, eq=False)
class Lanes:
    """The lanes of a road, numbered forward lanes first, from the middle of the road outwards.

    road
    offset     (L,) distance of each lane to the left of the centre line, m (where it runs beside the road)
    direction  (L,) +1 forward, -1 oncoming
    ending     the lane that ends, or -1
    end        distance at which it ends, m
    opening    distance from which vehicles may leave it, m
    approach   lateral distance from the road at which it starts, m
    taper      length over which cones move its traffic into the adjacent lane, m; 0: no cones
    """

    road: Road
    offset: FloatArray
    direction: IntArray
    ending: int = -1
    end: float = np.inf
    opening: float = 0.0
    approach: float = 0.0
    approach_length: float = 120.0
    taper: float = 0.0

    @property
    def forward(self) -> IntArray:
        return np.flatnonzero(self.direction > 0)

    @property
    def oncoming(self) -> IntArray:
        return np.flatnonzero(self.direction < 0)

    @property
    def adjacent(self) -> int:
        """The lane that traffic of the ending lane joins."""
        return self.ending - 1

    def lateral(self, lane: IntArray, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Offset d of the lanes' middle at travelled s, m, and its derivative by s; lane and s of one shape."""
        d = self.offset[lane]
        if self.taper > 0:
            share = (s - self.end) / self.taper + 1
            aside = np.where(lane == self.ending, self.offset[self.adjacent] - self.offset[self.ending], 0.0)
            return d + aside * smooth_step(share), aside * smooth_step_slope(share) / self.taper
        if self.ending < 0 or self.approach == 0:
            return d, np.zeros_like(d)
        share = (self.opening - s) / self.approach_length
        here = lane == self.ending
        outside = np.where(here, self.approach, 0.0)
        slope = outside * smooth_step_slope(share) / self.approach_length
        return d - outside * smooth_step(share), slope

    def road_s(self, lane: IntArray, s: FloatArray) -> FloatArray:
        """Road coordinate of travelled s, m."""
        return np.where(self.direction[lane] > 0, s, self.road.length - s)

    def neighbour(self, lane: IntArray, side: int) -> IntArray:
        """The lane on the left (side -1) or right (+1) as the driver sees it, or -1."""
        other = lane + side
        exists = (other >= 0) & (other < len(self.offset))
        other = np.where(exists, other, 0)
        return np.where(exists & (self.direction[other] == self.direction[lane]), other, -1)

    def may_change(self, lane: IntArray, target: IntArray, s: FloatArray) -> BoolArray:
        """True where a change from `lane` to the neighbour `target` is allowed at s; nobody enters an ending lane."""
        allowed = (target >= 0) & (target != self.ending if self.ending >= 0 else True)
        if self.taper > 0:
            return np.asarray(allowed & (lane != self.ending))
        return np.asarray(allowed & ((lane != self.ending) | (s >= self.opening)))

    def pose(self, lane: IntArray, s: FloatArray, d: FloatArray, slope: FloatArray) -> tuple[FloatArray, FloatArray]:
        """World position (..., 2), m, and heading (...), rad, at travelled s, offset d, where dd/ds = `slope`."""
        sign = self.direction[lane]
        along = self.road_s(lane, s)
        stretch = 1 - self.road.curvature_at(along) * d
        tangent = self.road.heading_at(along)
        heading = tangent + np.where(sign > 0, 0.0, np.pi) + sign * np.arctan2(slope, stretch)
        return self.road.position(along, d), heading

    def metric(self, lane: IntArray, s: FloatArray, d: FloatArray, slope: FloatArray) -> FloatArray:
        """Length travelled over ground per unit of s, at places as in `pose`."""
        return np.hypot(1 - self.road.curvature_at(self.road_s(lane, s)) * d, slope)


@dataclass(frozen=True, eq=False)
class LaneOrder:
    """Vehicles sorted by lane and distance, to find leaders and followers: keys lane * SPAN + s (E,), vehicles (E,)."""

    key: FloatArray
    vehicle: IntArray

    @classmethod
    def by_position(cls, s: FloatArray, lanes: IntArray) -> LaneOrder:
        """Sort vehicles by s (N,), m, in the lanes (N, 2) that each occupies: -1 for none, two during a change."""
        rows, columns = np.nonzero(lanes >= 0)
        key = lanes[rows, columns] * SPAN + s[rows]
        order = np.argsort(key, kind="stable")
        return cls(key[order], rows[order])

    def ahead(self, lane: IntArray, s: FloatArray) -> IntArray:
        """First vehicle (N,) beyond s (N,) in lane (N,), or -1; lanes may be -1."""
        return self._at(np.searchsorted(self.key, lane * SPAN + s, side="right"), lane)

    def behind(self, lane: IntArray, s: FloatArray) -> IntArray:
        """Last vehicle (N,) before s (N,) in lane (N,), or -1."""
        return self._at(np.searchsorted(self.key, lane * SPAN + s, side="left") - 1, lane)

    def _at(self, place: IntArray, lane: IntArray) -> IntArray:
        if len(self.key) == 0:
            return np.full(len(place), -1)
        inside = np.clip(place, 0, len(self.key) - 1)
        same = (inside == place) & (lane >= 0) & (np.floor_divide(self.key[inside], SPAN) == lane)
        return np.where(same, self.vehicle[inside], -1)

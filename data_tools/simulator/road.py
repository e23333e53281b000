"""Roads: a smooth centre line, and coordinates along and across it.

A position is given by s, the distance along the centre line, and d, the distance to its left (Frenet coordinates):

    p(s, d) = c(s) + d n(s),      c'(s) = t(s),      heading'(s) = kappa(s),      dp/ds at constant d = (1 - kappa d) t

The curvature kappa is a sum of smooth bumps; heading and centre line are its first and second integral on a fine grid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from saga_fg.numerics.arrays import FloatArray

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

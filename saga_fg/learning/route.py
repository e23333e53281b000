"""Route of a labelled object: along its labels from a moment on, and straight on from the last of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from saga_fg.learning.labelled_scene import LabelledScene
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.polyline import feet

STEP = 0.5  # m between points: shorter ones are noise
ONWARD = 80.0  # m beyond the last label


@dataclass(frozen=True, eq=False)
class Route:
    """A line of S segments: ends (S + 1, 2), m, world; way (S + 1,) along it, m; direction (S,), rad."""

    ends: FloatArray
    way: FloatArray
    direction: FloatArray

    @classmethod
    def of(cls, labelled: LabelledScene, row: int, start: int) -> Self | None:
        """The route of an object from a moment on; None where neither labels nor heading tell a direction."""
        labels = labelled.position[start:, row]
        points = [labels[0]]
        for point in labels[np.isfinite(labels[:, 0])]:
            if np.hypot(*(point - points[-1])) >= STEP:
                points.append(point)
        if len(points) > 2:
            onward = points[-1] - points[-3]
        else:
            yaw = labelled.yaw[start, row]
            onward = np.array([np.cos(yaw), np.sin(yaw)]) if np.isfinite(yaw) else points[-1] - points[0]
        length = float(np.hypot(*onward))
        if length == 0:
            return None
        return cls.through(np.array([*points, points[-1] + ONWARD / length * onward]))

    @classmethod
    def through(cls, ends: FloatArray) -> Self:
        """The route through points (S + 1, 2), neighbours apart."""
        step = np.diff(ends, axis=0)
        way = np.append(0.0, np.cumsum(np.hypot(step[:, 0], step[:, 1])))
        return cls(ends, way, np.arctan2(step[:, 1], step[:, 0]))

    def project(self, place: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Arc length (N,), m, lateral offset (N,), m, left is positive, and direction (N,), rad, of places (N, 2).

        NaN for places of NaN. The way of places behind the start is negative, the last segment runs on.
        """
        known = np.isfinite(place[:, 0])
        at = feet(self.ends, place[known])
        found = np.full((3, len(place)), np.nan)
        found[:, known] = at.s, at.e, np.arctan2(at.direction[:, 1], at.direction[:, 0])
        return found[0], found[1], found[2]

    def crossing(self, line: FloatArray) -> tuple[float, float]:
        """The way to a line (2, 2) that the route crosses, m, and its direction there; infinite where it does not."""
        a, step, across = self.ends[:-1], np.diff(self.ends, axis=0), line[1] - line[0]
        area = step[:, 0] * across[1] - step[:, 1] * across[0]
        offset = line[0] - a
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (offset[:, 0] * across[1] - offset[:, 1] * across[0]) / area
            u = (offset[:, 0] * step[:, 1] - offset[:, 1] * step[:, 0]) / area
        hit = np.flatnonzero((t >= 0) & (t <= 1) & (u >= 0) & (u <= 1))
        if len(hit) == 0:
            return float("inf"), 0.0
        k = int(hit[0])
        return float(self.way[k] + t[k] * (self.way[k + 1] - self.way[k])), float(self.direction[k])

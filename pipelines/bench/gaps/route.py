"""Where a labelled object goes: the way of its labels from a moment on, and straight on from the last of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from pipelines.bench.gaps.labelled import LabelledScene
from saga_fg.numerics.arrays import FloatArray

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

        NaN for places of NaN. The way of places behind the start is negative.
        """
        a, step = self.ends[:-1], np.diff(self.ends, axis=0)
        length = np.diff(self.way)
        offset = place[:, None] - a  # (N, S, 2)
        t = np.einsum("nsi,si->ns", offset, step) / length
        inside = np.clip(t, 0.0, length)
        inside[:, 0] = np.minimum(t[:, 0], length[0])
        across = (step[:, 0] * offset[..., 1] - step[:, 1] * offset[..., 0]) / length
        away = np.hypot(across, t - inside)
        nearest = np.where(np.isfinite(away), away, np.inf).argmin(axis=1)
        row = np.arange(len(place))
        sign = np.where(across[row, nearest] < 0, -1.0, 1.0)
        return (
            self.way[nearest] + inside[row, nearest],
            sign * away[row, nearest],
            np.where(np.isfinite(place[:, 0]), self.direction[nearest], np.nan),
        )

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

r"""Trails of earlier traffic: where vehicles went lately, and how fast; others can be expected to do as they did.

A trail is a row of points of one track, `SPACING` m apart, each with the direction of travel and the speed. A path is
predicted from a place and a course h in steps of ds: with the trails j near its next place, of each the nearest point,
d_j m away,

    k_j = exp( -d_j^2 / (2 reach^2) - (h_j - h)^2 / (2 TURN^2) ),   m, s^2: mean and variance of h_j - h under k_j
    h'  = h + c m + (1 - c) u ds,   c = K / (K + PRIOR) / (1 + s^2 / AGREEMENT^2),  K = sum of k_j

with u the curvature that the vehicle has itself, which fades along the way. Where there are no trails, it goes on as it
does; where they part, nothing is known of its course, until it is nearer to one of them. The mean of the speeds under
k_j is the typical speed at each place.

The trails need no map, outlive single tracks and are forgotten after `memory` s.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from saga_fg.kernels.compilation import compiled_kernels
from saga_fg.kernels.trails import trail_paths
from saga_fg.model.interactions import unit
from saga_fg.model.paths import Paths
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.columns import Columns
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.settings import NonNegative, Positive, Settings, setting

SPACING = 2.0  # m between the points of a trail
STEP = 3.0  # m between the points of a predicted path
NEAREST = 12  # trail points that are compared with a place
PRIOR = 0.2  # weight of going on as before, against that of one trail right here: few leave the path of others
TURN = 0.3  # rad, sigma of the kernel on the difference of headings
AGREEMENT = 0.2  # rad, deviation of the headings of trails from which they say little
_BEND = 20.0  # m, along which a curvature of one's own fades
_LEAST = 1e-9
_NO_POINTS = (np.empty(0, dtype=np.int64), np.empty((0, 2)), np.empty(0), np.empty(0))
_NEARER = np.tril(np.ones((NEAREST, NEAREST), dtype=np.bool_), -1)


@dataclass(frozen=True)
class TrailSettings(Settings):
    """Paths of vehicles that are not detected, along the trails of earlier traffic, see `saga_fg.tracking.trails`."""

    memory: NonNegative = setting(
        0.0, "remember the trails of traffic for this long, s; usual 30 to 120; higher: older traffic counts, 0: none"
    )
    reach: Positive = setting(
        1.5, "sigma of the kernel on the distance to a trail, m; usual half a lane; higher: other lanes count"
    )


@dataclass(frozen=True, eq=False)
class TrailPoints(Columns):
    """n points: id of the track, position (n, 2), world, m, heading, rad, speed, m/s, time, s."""

    id: IntArray
    position: FloatArray
    heading: FloatArray
    speed: FloatArray
    time: FloatArray


class _Beside(NamedTuple):
    """What trails tell of n places, each (n,): mean of h_j - h, rad, certainty c, variance s^2, typical speed, m/s, and
    K."""

    turn: FloatArray
    certainty: FloatArray
    variance: FloatArray
    speed: FloatArray
    weight: FloatArray


@dataclass(eq=False)
class Trails:
    """The trails of the last `memory` seconds."""

    settings: TrailSettings
    points: TrailPoints | None = None
    latest: TrailPoints | None = None  # of each track, by id
    _tree: cKDTree | None = field(default=None, repr=False)

    def update(self, passing: TrailPoints, time: float) -> None:
        """Remember where moving tracks are at `time`, s, every `SPACING` m, and forget what is older than `memory`."""
        if self.settings.memory == 0:
            return
        self._forget(time - self.settings.memory)
        if self.points is None or self.latest is None:
            self.points, latest = passing, passing
        else:
            new = passing.select(np.flatnonzero(self._moved(passing, self.latest)))
            if len(new) == 0:
                return
            self.points = self.points.append(new)
            latest = self.latest.select(~np.isin(self.latest.id, new.id)).append(new)
        self.latest, self._tree = latest.select(np.argsort(latest.id)), None

    def _forget(self, since: float) -> None:
        """Drop the points before `since`, s."""
        if self.points is None or self.latest is None or len(self.points) == 0 or self.points.time[0] >= since:
            return  # points are in the order of time
        self.points, self._tree = self.points.select(self.points.time >= since), None
        self.latest = self.latest.select(self.latest.time >= since)

    @staticmethod
    def _moved(passing: TrailPoints, latest: TrailPoints) -> BoolArray:
        """(n,) whether tracks are at least `SPACING` m from their latest points, or have none."""
        at = np.minimum(np.searchsorted(latest.id, passing.id), len(latest) - 1)
        if len(latest) == 0:
            return np.ones(len(passing), dtype=np.bool_)
        dx, dy = (passing.position - latest.position[at]).T
        return np.asarray((latest.id[at] != passing.id) | (dx * dx + dy * dy >= SPACING**2))

    def _beside(self, ids: IntArray, position: FloatArray, heading: FloatArray) -> _Beside:
        """The trails beside places (n, 2), world, with headings (n,), rad, without those of the tracks `ids` (n,)."""
        points, reach = self.points, self.settings.reach
        if points is None or len(points) == 0:
            return _Beside(*np.zeros((5, len(heading))))
        if self._tree is None:
            self._tree = cKDTree(points.position, balanced_tree=False, compact_nodes=False)
        apart, at = self._tree.query(position, k=NEAREST, distance_upper_bound=2 * reach)
        most = int(np.isfinite(apart).sum(axis=1).max(initial=0))
        apart, at = apart[:, :most], np.minimum(at[:, :most], len(points) - 1)
        of = points.id[at]
        again = ((of[:, :, None] == of[:, None]) & _NEARER[:most, :most]).any(axis=2)
        found = np.isfinite(apart) & (of != ids[:, None]) & ~again
        turn = wrap_angle(points.heading[at] - heading[:, None])
        aside = np.where(found, apart, 0.0)
        k = np.exp(-((aside / reach) ** 2 + (turn / TURN) ** 2) / 2) * found
        total = k.sum(axis=1)
        share = k / np.maximum(total, _LEAST)[:, None]
        mean = (share * turn).sum(axis=1)
        variance = (share * (turn - mean[:, None]) ** 2).sum(axis=1)
        certainty = total / (total + PRIOR) / (1 + variance / AGREEMENT**2)
        return _Beside(mean, certainty, variance, (share * points.speed[at]).sum(axis=1), total)

    def paths(
        self, ids: IntArray, position: FloatArray, heading: FloatArray, curvature: FloatArray, steps: int
    ) -> Paths:
        """Predict the paths of n tracks at `position` (n, 2), world, with a `curvature` (n,) of their own, 1/m.

        Their steps are `STEP` m long, their rows 0 to n - 1.
        """
        if compiled_kernels():
            points, scales = self.points, (self.settings.reach, STEP, _BEND, TURN, PRIOR, AGREEMENT)
            known = _NO_POINTS if points is None else (points.id, points.position, points.heading, points.speed)
            tracks = ids, position, heading, curvature
            return Paths(np.arange(len(ids)), *trail_paths(*known, *tracks, steps, NEAREST, *scales))
        place, beside = position, self._beside(ids, position, heading)
        course = heading + beside.certainty * beside.turn
        certainty, disagreement = beside.certainty, beside.variance
        columns = [(place, course, beside.speed, beside.weight)]
        for step in range(steps):
            own = curvature * STEP * np.exp(-(step + 0.5) * STEP / _BEND)
            beside = self._beside(ids, place + STEP * unit(course + own / 2), course)
            after = course + beside.certainty * beside.turn + (1 - beside.certainty) * own
            place = place + STEP * unit((course + after) / 2)
            course = after
            columns.append((place, course, beside.speed, beside.weight))
        places, courses, speeds, weights = (np.stack(column, axis=1) for column in zip(*columns, strict=True))
        return Paths(np.arange(len(ids)), places, courses, speeds, weights, certainty, disagreement)

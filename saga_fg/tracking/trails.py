r"""Predicted paths along the trails of earlier traffic and the lanes of the map.

A trail is the row of passages of one track, or the centre of a lane (`saga_fg.tracking.traffic`). A path is predicted
from a place and a course h in steps of ds, with u the curvature that the vehicle has itself, which fades along the way.
With the trails j near its next place, of each the nearest point, d_j m away,

    k_j = exp( -d_j^2 / (2 reach^2) - (h_j - h - u ds)^2 / (2 TURN^2) ),   m, s^2: mean and variance of h_j - h
    h'  = h + c m + (1 - c) u ds,   c = K / (K + PRIOR) / (1 + s^2 / AGREEMENT^2),  K = sum of k_j

Where there are no trails, it goes on as it does; at a fork it keeps to the trail that it turns with; where they part
and it agrees with both, nothing is known of its course, until it is nearer to one of them. The mean of the speeds under
k_j is the typical speed at each place; lanes tell none.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from saga_fg.kernels.compilation import compiled_by
from saga_fg.kernels.trails import trail_paths
from saga_fg.model.interactions import unit
from saga_fg.model.paths import Paths
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.tracking.traffic import Traffic, TrailPoints, Trails

STEP = 3.0  # m between the points of a predicted path
NEAREST = 12  # passages that are compared with a place
PRIOR = 0.2  # weight of going on as before, against that of one trail right here: few leave the path of others
TURN = 0.3  # rad, sigma of the kernel on the difference of headings
AGREEMENT = 0.2  # rad, deviation of the headings of trails from which they say little
_BEND = 20.0  # m, along which a curvature of one's own fades
_LEAST = 1e-9
_NONE = Trails(TrailPoints.empty())
_NEARER = np.tril(np.ones((NEAREST, NEAREST), dtype=np.bool_), -1)


class _Beside(NamedTuple):
    """Statistics of the trails near n places, each (n,): mean of h_j - h, rad, certainty c, variance s^2, typical
    speed, m/s, and its weight."""

    turn: FloatArray
    certainty: FloatArray
    variance: FloatArray
    speed: FloatArray
    weight: FloatArray


def _paths_by_kernel(
    traffic: Traffic, ids: IntArray, position: FloatArray, heading: FloatArray, curvature: FloatArray, steps: int
) -> Paths:
    reach = max(traffic.settings.reach, _LEAST)
    lanes, trails = (_columns(each, 2 * reach) for each in _found(traffic))
    tracks, scales = (ids, position, heading, curvature), (reach, STEP, _BEND, TURN, PRIOR, AGREEMENT)
    return Paths(np.arange(len(ids)), *trail_paths(*lanes, *trails, *tracks, steps, NEAREST, *scales))


@compiled_by(_paths_by_kernel)
def paths(
    traffic: Traffic, ids: IntArray, position: FloatArray, heading: FloatArray, curvature: FloatArray, steps: int
) -> Paths:
    """Predict the paths of n tracks `ids` at `position` (n, 2), world, with a `curvature` (n,) of their own, 1/m.

    Their steps are `STEP` m long, their rows 0 to n - 1.
    """
    place, beside = position, _beside(traffic, ids, position, heading)
    course = heading + beside.certainty * beside.turn
    certainty, disagreement = beside.certainty, beside.variance
    columns = [(place, course, beside.speed, beside.weight)]
    for step in range(steps):
        own = curvature * STEP * np.exp(-(step + 0.5) * STEP / _BEND)
        beside = _beside(traffic, ids, place + STEP * unit(course + own / 2), course + own)
        after = course + own + beside.certainty * beside.turn
        place = place + STEP * unit((course + after) / 2)
        course = after
        columns.append((place, course, beside.speed, beside.weight))
    places, courses, speeds, weights = (np.stack(column, axis=1) for column in zip(*columns, strict=True))
    return Paths(np.arange(len(ids)), places, courses, speeds, weights, certainty, disagreement)


def _found(traffic: Traffic) -> tuple[Trails, Trails]:
    """The lanes, and the trails of traffic, that lead others."""
    return (traffic.lanes, traffic.trails()) if traffic.settings.reach > 0 else (_NONE, _NONE)


def _columns(trails: Trails, cell: float) -> tuple[IntArray, FloatArray, FloatArray, FloatArray, BoolArray, Any, Any]:
    """Trails as arrays for the kernel: tracks, places, headings, speeds, flags of known speeds, and grid cells."""
    points = trails.points
    return points.id, points.position, points.heading, points.speed, points.timed, *trails.cells(cell)


def _beside(traffic: Traffic, ids: IntArray, position: FloatArray, heading: FloatArray) -> _Beside:
    """The trails beside places (n, 2), world, with headings (n,), rad, without those of the tracks `ids` (n,)."""
    reach = traffic.settings.reach
    found = [_nearest(each, position, 2 * reach) for each in _found(traffic) if len(each)]
    if not found:
        return _Beside(*np.zeros((5, len(heading))))
    apart, of, headings, speeds, known = (np.concatenate(each, axis=1) for each in zip(*found, strict=True))
    most = min(NEAREST, int(np.isfinite(apart).sum(axis=1).max(initial=0)))
    order = np.argsort(apart, axis=1, kind="stable")[:, :most]
    apart, of, headings, speeds, known = (
        np.take_along_axis(each, order, axis=1) for each in (apart, of, headings, speeds, known)
    )
    again = ((of[:, :, None] == of[:, None]) & _NEARER[:most, :most]).any(axis=2)
    other = np.isfinite(apart) & (of != ids[:, None]) & ~again
    turn = wrap_angle(headings - heading[:, None])
    aside = np.where(other, apart, 0.0)
    k = np.exp(-((aside / reach) ** 2 + (turn / TURN) ** 2) / 2) * other
    total = k.sum(axis=1)
    share = k / np.maximum(total, _LEAST)[:, None]
    mean = (share * turn).sum(axis=1)
    variance = (share * (turn - mean[:, None]) ** 2).sum(axis=1)
    certainty = total / (total + PRIOR) / (1 + variance / AGREEMENT**2)
    timed = k * known
    weight = timed.sum(axis=1)
    speed = (timed * speeds).sum(axis=1) / np.maximum(weight, _LEAST)
    return _Beside(mean, certainty, variance, speed, weight)


def _nearest(
    trails: Trails, position: FloatArray, farthest: float
) -> tuple[FloatArray, IntArray, FloatArray, FloatArray, BoolArray]:
    """The nearest points of trails to places (n, 2), each (n, NEAREST): distance, m, track, heading, speed, whether
    this is known."""
    apart, at = trails.tree.query(position, k=NEAREST, distance_upper_bound=farthest)
    at, points = np.minimum(at, len(trails) - 1), trails.points
    return apart, points.id[at], points.heading[at], points.speed[at], points.timed[at]

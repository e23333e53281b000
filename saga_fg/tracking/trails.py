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

from typing import Any

import numpy as np

from saga_fg.kernels.trails import trail_paths
from saga_fg.model.paths import Paths
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.tracking.traffic import Traffic, TrailPoints, Trails

STEP = 3.0  # m between the points of a predicted path
NEAREST = 12  # passages that are compared with a place
PRIOR = 0.2  # weight of going on as before, against that of one trail right here: few leave the path of others
TURN = 0.3  # rad, sigma of the kernel on the difference of headings
AGREEMENT = 0.2  # rad, deviation of the headings of trails from which they say little
_BEND = 20.0  # m, along which a curvature of one's own fades
_LEAST = 1e-9
_NONE = Trails(TrailPoints.empty())


def paths(
    traffic: Traffic, ids: IntArray, position: FloatArray, heading: FloatArray, curvature: FloatArray, steps: int
) -> Paths:
    """Predict the paths of n tracks `ids` at `position` (n, 2), world, with a `curvature` (n,) of their own, 1/m.

    Their steps are `STEP` m long, their rows 0 to n - 1.
    """
    reach = max(traffic.settings.reach, _LEAST)
    lanes, trails = (_columns(each, 2 * reach) for each in _found(traffic))
    tracks, scales = (ids, position, heading, curvature), (reach, STEP, _BEND, TURN, PRIOR, AGREEMENT)
    return Paths(np.arange(len(ids)), *trail_paths(*lanes, *trails, *tracks, steps, NEAREST, *scales))


def _found(traffic: Traffic) -> tuple[Trails, Trails]:
    """The lanes, and the trails of traffic, that lead others."""
    return (traffic.lanes, traffic.trails()) if traffic.settings.reach > 0 else (_NONE, _NONE)


def _columns(trails: Trails, cell: float) -> tuple[IntArray, FloatArray, FloatArray, FloatArray, BoolArray, Any, Any]:
    """Trails as arrays for the kernel: tracks, places, headings, speeds, flags of known speeds, and grid cells."""
    points = trails.points
    return points.id, points.position, points.heading, points.speed, points.timed, *trails.cells(cell)

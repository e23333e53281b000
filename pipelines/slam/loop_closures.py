"""Loop closures: revisited places, found by distance and verified by registration.

A keyframe j is compared with the nearest earlier keyframe i from which it has driven a long way since. Its scan is
registered with the surfels of the keyframes around i, started where the present estimate says. It is a loop where that
converges, enough of the points have a surfel, and the residual is no larger than between neighbours. A robust
loss takes care of false loops that remain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from data_tools.lidar import RegistrationError, RegistrationSettings, SurfelMap, register, voxel_downsample
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform, transform_points
from saga_fg.settings import (
    Fraction,
    Positive,
    Range,
    Settings,
    setting,
    settings_group,
)


@dataclass(frozen=True)
class LoopSettings(Settings):
    """Conditions for comparing two keyframes, and for taking them for one place."""

    max_distance: Positive = setting(
        8.0, "largest distance of two keyframes that are compared, m; higher: finds loops after more drift, slower"
    )
    min_path: Positive = setting(30.0, "least distance driven between two keyframes of a loop, m")
    search_interval: Positive = setting(5.0, "distance driven between two searches, m")
    map_keyframes: Annotated[int, Range(0, 1000)] = setting(
        4, "keyframes on either side whose scans make the map for registration"
    )
    surfel_size: Positive = setting(1.0, "voxel size of that map, m")
    scan_spacing: Positive = setting(1.0, "spacing of the points of a scan that is registered, m; higher: faster")
    min_overlap: Fraction = setting(0.5, "least share of the points that have a surfel; higher: fewer, surer loops")
    max_residual: Positive = setting(0.3, "largest mean distance of points from their surfels, m")
    registration: RegistrationSettings = settings_group(RegistrationSettings, "registration of the scan in the map")


@dataclass(frozen=True, eq=False)
class LoopClosure:
    """Keyframe `second` seen from keyframe `first`: first_T_second (4, 4), covariance (6, 6) of its tangent."""

    first: int
    second: int
    first_T_second: FloatArray
    covariance: FloatArray


def find_loops(
    clouds: Sequence[FloatArray], world_T_lidar: FloatArray, settings: LoopSettings | None = None
) -> list[LoopClosure]:
    """Find the loops of K keyframes: points (N, 3) of each in its sensor's frame, and estimated poses (K, 4, 4)."""
    s = settings or LoopSettings()
    places = world_T_lidar[:, :3, 3]
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
    loops, searched = [], -np.inf
    for j in range(len(clouds)):
        earlier = np.flatnonzero(way[j] - way >= s.min_path)
        if not len(earlier) or way[j] - searched < s.search_interval:
            continue
        distance = np.linalg.norm(places[earlier] - places[j], axis=1)
        if distance.min() > s.max_distance:
            continue
        searched = float(way[j])
        loop = _proved(clouds, world_T_lidar, int(earlier[distance.argmin()]), j, s)
        if loop is not None:
            loops.append(loop)
    return loops


def _proved(
    clouds: Sequence[FloatArray], world_T_lidar: FloatArray, i: int, j: int, s: LoopSettings
) -> LoopClosure | None:
    i_T_world = inverse_transform(world_T_lidar[i])
    surfels = SurfelMap(s.surfel_size, reach=np.inf)
    for k in range(max(0, i - s.map_keyframes), min(j, i + s.map_keyframes + 1)):
        surfels.add(transform_points(i_T_world @ world_T_lidar[k], clouds[k]), np.zeros(3))
    points = clouds[j][voxel_downsample(clouds[j], s.scan_spacing)]
    start = i_T_world @ world_T_lidar[j]
    try:
        rough = register(points, surfels, start, 3 * s.surfel_size, 1.0, s.registration)
        found = register(points, surfels, rough.map_T_scan, s.surfel_size, 0.1, s.registration)
    except RegistrationError:
        return None
    if not found.converged or found.pairs < s.min_overlap * len(points) or found.residual > s.max_residual:
        return None
    return LoopClosure(i, j, found.map_T_scan, found.covariance)

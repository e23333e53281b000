"""Loop closures: revisited places, found by distance and verified by registration.

A submap is compared with the nearest earlier one from which the vehicle has driven a long way since. Its points are
registered with the surfels of that one, started where the present estimate says. It is a loop where that converges,
enough of the points have a surfel, and the residual is no larger than between neighbours. A robust loss takes care of
false loops that remain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_tools.lidar import (
    RegistrationError,
    RegistrationSettings,
    Submap,
    SurfelMap,
    register,
    voxel_downsample,
)
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform
from saga_fg.settings import (
    Fraction,
    Positive,
    Settings,
    setting,
    settings_group,
)


@dataclass(frozen=True)
class LoopSettings(Settings):
    """Conditions for comparing two submaps, and for taking them for one place."""

    max_distance: Positive = setting(
        20.0, "largest distance of two submaps that are compared, m; higher: finds loops after more drift, slower"
    )
    min_path: Positive = setting(30.0, "least distance driven between two submaps of a loop, m")
    surfel_size: Positive = setting(1.0, "voxel size of that map, m")
    scan_spacing: Positive = setting(1.0, "spacing of the points of a submap that is registered, m; higher: faster")
    min_overlap: Fraction = setting(0.3, "least share of the points that have a surfel; higher: fewer, surer loops")
    max_residual: Positive = setting(0.3, "largest mean distance of points from their surfels, m")
    registration: RegistrationSettings = settings_group(RegistrationSettings, "registration of a submap in another")


@dataclass(frozen=True, eq=False)
class LoopClosure:
    """`second` seen from `first`, keyframes or submaps: first_T_second (4, 4), covariance (6, 6) of its tangent."""

    first: int
    second: int
    first_T_second: FloatArray
    covariance: FloatArray


class NearbySubmaps:
    """Looks for loops among the submaps nearest by the present estimate."""

    def __init__(self, settings: LoopSettings | None = None) -> None:
        self._settings = settings or LoopSettings()
        self._submaps: list[Submap] = []

    def add(self, submap: Submap, world_T_submap: FloatArray) -> list[LoopClosure]:
        """Take the next submap, and return the loop found, if any; world_T_submap: (n, 4, 4) of all submaps."""
        self._submaps.append(submap)
        s, places = self._settings, world_T_submap[:, :3, 3]
        earlier = [one.number for one in self._submaps if submap.way[0] - one.way[1] >= s.min_path]
        if not earlier or not len(submap.points):
            return []
        distance = np.linalg.norm(places[earlier] - places[submap.number], axis=1)
        if distance.min() > s.max_distance:
            return []
        i = earlier[int(distance.argmin())]
        start = inverse_transform(world_T_submap[i]) @ world_T_submap[submap.number]
        loop = _proved(self._submaps[i], submap, start, s)
        return [] if loop is None else [loop]


def _proved(first: Submap, second: Submap, start: FloatArray, s: LoopSettings) -> LoopClosure | None:
    surfels = SurfelMap(s.surfel_size, reach=np.inf)
    surfels.add(first.points.astype(np.float64), np.zeros(3))
    points = second.points.astype(np.float64)
    points = points[voxel_downsample(points, s.scan_spacing)]
    try:
        rough = register(points, surfels, start, 3 * s.surfel_size, 1.0, s.registration)
        found = register(points, surfels, rough.map_T_scan, s.surfel_size, 0.1, s.registration)
    except RegistrationError:
        return None
    if not found.converged or found.pairs < s.min_overlap * len(points) or found.residual > s.max_residual:
        return None
    return LoopClosure(first.number, second.number, found.map_T_scan, found.covariance)

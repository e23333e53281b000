"""The proof that two clouds show one place: registration, first rough and then fine, and rivals.

A place that fits nearly as well elsewhere is none: the same two clouds aligned otherwise (row houses), or another place
that says that the vehicle is elsewhere (streets that look alike).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data_tools.lidar import Registration, RegistrationError, RegistrationSettings, SurfelMap, register
from data_tools.lidar.places import PlaceMatch
from data_tools.lidar.registration import Undetermined
from saga_fg.numerics.arrays import FloatArray

FEWEST = 200  # points of a submap that shows a place
COMPARED = 12  # places whose images are compared in each search
SURFEL, SPACING = 1.0, 1.5  # m: voxels of the map, and spacing of the points registered
SAME = 4.0  # m that two findings of one place differ by, besides drift
_SINGLE = 0.8  # share of the correlation that another alignment of the two may have
_UNIQUE = 0.92  # share of the structure in common that another place may have


def registered(
    old: FloatArray,
    points: FloatArray,
    old_T_points: FloatArray,
    settings: RegistrationSettings,
    undetermined: Undetermined = "refuse",
) -> Registration | None:
    """Register points (N, 3) with the points (M, 3) of a place, from an alignment of images; None: they do not fit."""
    surfels = SurfelMap(SURFEL, reach=np.inf)
    surfels.add(old, np.zeros(3))
    try:
        rough = register(points, surfels, old_T_points, 3 * SURFEL, 1.0, settings, undetermined)
        fine = register(points, surfels, rough.map_T_scan, SURFEL, 0.1, settings, undetermined)
    except RegistrationError:
        return None
    return fine if fine.converged else None


def fits_otherwise(match: PlaceMatch) -> bool:
    """True if another alignment of the two is nearly as good."""
    return match.rival > _SINGLE * match.score


def agreeing(places: FloatArray, overlap: FloatArray, spread: FloatArray | float = SAME) -> Sequence[int]:
    """Those of the places (P, 3), m, that agree with the first; none if another is nearly as good and says otherwise.

    overlap (P,) of each, spread (P,) m that it may be off the first
    """
    elsewhere = np.linalg.norm(places - places[0], axis=1) >= spread
    if (overlap[elsewhere] > _UNIQUE * overlap[0]).any():
        return []
    return np.flatnonzero(~elsewhere).tolist()

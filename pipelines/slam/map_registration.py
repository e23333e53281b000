"""Scans against a map: registered with the surfels around the vehicle, and compared with what stands there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_tools.lidar import Registration, RegistrationError, SurfelMap, register, voxel_downsample
from data_tools.lidar.overlap import Structure
from factors import Robust, pose_prior_factor
from pipelines.slam.map_places import MapPlaces
from pipelines.slam.place_proof import SURFEL
from saga_fg.graph import EGO_POSE, Additions, GraphView
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform, transform_points

_MAX_RESIDUAL = 0.3  # largest mean distance of the points of a scan from the map, m
_MIN_PAIRS = 0.4  # least share of the points of a scan that the map must have surfels for
_RELOADED = 15.0  # m of way after which the surfels around are taken anew


class MapRegistration:
    """The surroundings of a place in a map, which follow the vehicle; spacing: of the points registered, m."""

    def __init__(self, places: MapPlaces, spacing: float) -> None:
        self._places, self._spacing = places, spacing
        self._surfels, self._centre = SurfelMap(SURFEL, np.inf), np.full(3, np.inf)
        self._structure, self._structure_frame = Structure.of(np.zeros((1, 3))), np.eye(4)

    def registered(self, points: FloatArray, predicted: FloatArray, rough: bool) -> Registration | None:
        """The registration of a scan (N, 3) with the map, None where it does not fit.

        predicted: map_T_scan (4, 4); rough: to metres alone
        """
        if np.linalg.norm(predicted[:3, 3] - self._centre) > _RELOADED:
            self._load(predicted[:3, 3])
        thin = points[voxel_downsample(points, self._spacing)] if len(points) else points
        criteria, start = self._places.registration, predicted
        try:
            if rough:
                start = register(thin, self._surfels, start, 3 * SURFEL, 1.0, criteria, "hold").map_T_scan
            found = register(thin, self._surfels, start, 1.5 * SURFEL, 0.1, criteria, "hold")
        except RegistrationError:
            return None
        fits = found.converged and found.pairs >= _MIN_PAIRS * len(thin) and found.residual <= _MAX_RESIDUAL
        return found if fits else None

    def agreement(self, points: FloatArray, map_T_points: FloatArray) -> float | None:
        """Share of what stands above the ground in points (N, 3) that the map has, None where there is too little."""
        near_T_points = inverse_transform(self._structure_frame) @ map_T_points
        return self._structure.agreement(Structure.of(points), near_T_points)

    def _load(self, centre: FloatArray) -> None:
        """Take the surfels and the structure around a place."""
        points, frame = self._places.around(self._places.nearest(centre), centre)
        self._surfels, self._centre = SurfelMap(SURFEL, np.inf), centre
        self._surfels.add(transform_points(frame, points), centre)
        self._structure, self._structure_frame = Structure.of(points), frame


@dataclass(frozen=True, eq=False)
class MeasuredPose:
    """Provider of the pose of this epoch as measured in the map: (4, 4) and its covariance (6, 6), with a loss."""

    map_T_lidar: FloatArray
    covariance: FloatArray
    robust: Robust
    name: str = "map"

    def factors(self, view: GraphView) -> Additions:
        key = view.key(EGO_POSE, 0)
        return Additions(factors=[pose_prior_factor(key, self.map_T_lidar, self.covariance, self.robust)])

"""The places of a map: the points around one, what stands there, and the place that a cloud shows."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from data_tools.lidar import RegistrationSettings, voxel_downsample
from data_tools.lidar.overlap import Structure
from data_tools.lidar.places import PlaceImage, PlaceIndex
from pipelines.slam.place_proof import COMPARED, FEWEST, agreeing, fits_otherwise, registered
from pipelines.slam.slam_map import SlamMap
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform, transform_points

_REGISTERED = 6  # places for each search


@dataclass(eq=False)
class MapPlaces:
    """Places of a map, m.

    radius       of what counts as around a place
    min_overlap  share of the structure that a cloud and its place have in common
    spacing      of the points that are registered
    ambiguous    whether the last cloud that was looked for has fitted several places
    """

    slam_map: SlamMap
    radius: float
    min_overlap: float
    spacing: float
    registration: RegistrationSettings
    ambiguous: bool = False
    _index: PlaceIndex | None = field(default=None, init=False)

    def around(self, number: int, centre: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
        """Points (N, 3) around a centre, that of submap `number` if None, in its frame, and that frame (4, 4)."""
        frames = self.slam_map.map_T_submap
        frame = frames[number]
        near = np.linalg.norm(frames[:, :3, 3] - (frame[:3, 3] if centre is None else centre), axis=1) <= self.radius
        near[number] = True
        inverse = inverse_transform(frame)
        moved = [
            transform_points(inverse @ frames[k], self.slam_map.points[k].astype(np.float64))
            for k in np.flatnonzero(near).tolist()
        ]
        return np.concatenate(moved), frame

    def nearest(self, centre: FloatArray) -> int:
        """The submap whose frame is nearest to a point (3,) of the map."""
        return int(np.argmin(np.linalg.norm(self.slam_map.map_T_submap[:, :3, 3] - centre, axis=1)))

    def recognised(self, query: FloatArray, near: FloatArray | None = None) -> FloatArray | None:
        """map_T_query (4, 4) of the one place that points (N, 3), z up, show, None for none and for several.

        near: a place (2,) or (3,) in the map; places farther than the radius from it are left out
        """
        self.ambiguous = False
        if len(query) < FEWEST:
            return None
        if self._index is None:
            self._index = PlaceIndex()
            for number, cloud in enumerate(self.slam_map.points):
                if len(cloud) >= FEWEST:
                    self._index.add(number, PlaceImage.of(cloud.astype(np.float64)))
        mine, points = Structure.of(query), query[voxel_downsample(query, self.spacing)]
        found: list[tuple[float, FloatArray]] = []
        otherwise = False
        older = None
        if near is not None:
            off = np.linalg.norm(self.slam_map.map_T_submap[:, :2, 3] - near[:2], axis=1)
            older = np.flatnonzero(off <= self.radius).tolist()
        for match in self._index.candidates(PlaceImage.of(query), older, COMPARED)[:_REGISTERED]:
            around, frame = self.around(match.number)
            fine = registered(around, points, match.place_T_query, self.registration)
            if fine is None:
                continue
            overlap = Structure.of(around).shared(mine, fine.map_T_scan)
            if overlap > self.min_overlap:
                if fits_otherwise(match):
                    otherwise = True
                else:
                    found.append((overlap, frame @ fine.map_T_scan))
        found.sort(key=lambda one: -one[0])
        self.ambiguous = otherwise and not found
        if not found:
            return None
        places = np.array([map_T_query for _, map_T_query in found])
        agreed = agreeing(places[:, :3, 3], np.array([overlap for overlap, _ in found]))
        self.ambiguous = not agreed
        return places[0] if agreed else None

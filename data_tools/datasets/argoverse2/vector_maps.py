"""The vector maps of Argoverse 2 logs, where they are there: LOG/map/log_map_archive_*.json.

    {"drivable_areas": {ID: {"area_boundary": [POINT, ...]}},
     "pedestrian_crossings": {ID: {"edge1": [POINT, POINT], "edge2": [POINT, POINT]}},
     "lane_segments": {ID: {"left_lane_boundary": [POINT, ...], "right_lane_boundary": [POINT, ...]}}}

POINT is {"x", "y", "z"}, m, in the frame of the city. Format: https://argoverse.github.io/user-guide/api/hd_maps.html.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.datasets.area_map import AreaMap, Kind
from data_tools.files.input_files import read_bytes
from data_tools.files.json_stream import parsed_json
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.dataset import Scene

BORDERS = ("left_lane_boundary", "right_lane_boundary")


def argoverse_maps(root: Path, scenes: Mapping[str, Scene]) -> dict[str, AreaMap]:
    """Return the maps of logs that have one. Raises `InputError` for a broken one."""
    found = {}
    for name, scene in scenes.items():
        for path in sorted((root / name / "map").glob("log_map_archive_*.json"))[:1]:
            raw = parsed_json(read_bytes(path), str(path))
            try:
                found[name] = AreaMap.around(scene, list(_areas(raw)), list(_borders(raw)))
            except (KeyError, TypeError, ValueError, AttributeError) as error:
                raise InputError(f"{path}: expected a map of Argoverse 2: {error!r}") from error
    return found


def _areas(raw: Any) -> Iterator[tuple[Kind, Sequence[FloatArray]]]:
    for area in raw["drivable_areas"].values():
        yield "drivable", [_points(area["area_boundary"])]
    for crossing in raw["pedestrian_crossings"].values():
        near, far = _points(crossing["edge1"]), _points(crossing["edge2"])
        yield "crossing", [np.concatenate([near, far[::-1]])]


def _borders(raw: Any) -> Iterator[FloatArray]:
    for lane in raw["lane_segments"].values():
        for border in BORDERS:
            yield _points(lane[border])


def _points(points: Any) -> FloatArray:
    array = np.array([(point["x"], point["y"]) for point in points], dtype=np.float64).reshape(-1, 2)
    if not np.isfinite(array).all():
        raise ValueError("points that are not finite")
    return array

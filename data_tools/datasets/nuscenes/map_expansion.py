"""The vector maps of nuScenes, where the map expansion lies below the dataroot: maps/expansion/LOCATION.json.

    {"node": [{"token", "x", "y"}], "line": [{"token", "node_tokens"}],
     "polygon": [{"token", "exterior_node_tokens", "holes": [{"node_tokens"}]}],
     "drivable_area": [{"polygon_tokens"}], "ped_crossing" and "walkway": [{"polygon_token"}],
     "road_divider" and "lane_divider": [{"line_token"}]}

Format: https://github.com/nutonomy/nuscenes-devkit/blob/master/docs/schema_nuscenes.md and its map API.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.datasets.area_map import AreaMap, Kind
from data_tools.datasets.nuscenes.tables import read_table
from data_tools.files.input_files import read_bytes
from data_tools.files.json_stream import parsed_json
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.dataset import Scene

AREAS: tuple[tuple[str, Kind], ...] = (
    ("drivable_area", "drivable"),
    ("walkway", "walkway"),
    ("ped_crossing", "crossing"),
)
LINES = ("road_divider", "lane_divider")
LOCATIONS = ("boston-seaport", "singapore-hollandvillage", "singapore-onenorth", "singapore-queenstown")


def nuscenes_maps(dataroot: Path, folder: Path, scenes: Mapping[str, Scene]) -> dict[str, AreaMap]:
    """Return the maps of scenes whose place has a file; the tables are in `folder`.

    Raises `InputError` for broken tables and maps.
    """
    if not any((dataroot / "maps" / "expansion" / f"{place}.json").is_file() for place in LOCATIONS):
        return {}
    places = dict(read_table(folder, "log", ("token", "location")))
    scene_places = {name: places.get(log) for name, log in read_table(folder, "scene", ("name", "log_token"))}
    opened: dict[Path, _Layers] = {}
    found = {}
    for name, scene in scenes.items():
        place = scene_places.get(name)
        path = dataroot / "maps" / "expansion" / f"{place}.json"
        if place in LOCATIONS and path.is_file():
            if path not in opened:
                opened = {path: _Layers(path)}  # one at a time: a map has tens of megabytes
            found[name] = AreaMap.around(scene, opened[path].areas(), opened[path].lines())
    return found


class _Layers:
    """The layers of a file. Raises `InputError` where it is broken."""

    def __init__(self, path: Path) -> None:
        self._path, self._raw = path, parsed_json(read_bytes(path), str(path))
        self._nodes = {row["token"]: (row["x"], row["y"]) for row in self._rows("node", ("token", "x", "y"))}
        self._lines = {row["token"]: row["node_tokens"] for row in self._rows("line", ("token", "node_tokens"))}
        self._polygons = {
            row["token"]: row for row in self._rows("polygon", ("token", "exterior_node_tokens", "holes"))
        }

    def areas(self) -> Iterator[tuple[Kind, Sequence[FloatArray]]]:
        for layer, kind in AREAS:
            for row in self._rows(layer, ()):
                for token in row.get("polygon_tokens", [row.get("polygon_token")]):
                    polygon = self._known(self._polygons, layer, token)
                    holes = [self._points(layer, hole["node_tokens"]) for hole in polygon["holes"]]
                    yield kind, [self._points(layer, polygon["exterior_node_tokens"]), *holes]

    def lines(self) -> Iterator[FloatArray]:
        for layer in LINES:
            for row in self._rows(layer, ("line_token",)):
                yield self._points(layer, self._known(self._lines, layer, row["line_token"]))

    def _rows(self, layer: str, fields: tuple[str, ...]) -> list[dict[str, Any]]:
        rows = self._raw.get(layer) if isinstance(self._raw, dict) else None
        if not isinstance(rows, list):
            raise InputError(f"{self._path}: expected a map with the layer {layer}")
        for number, row in enumerate(rows):
            missing = None if isinstance(row, dict) else "an object"
            missing = missing or next((field for field in fields if field not in row), None)
            if missing:
                raise InputError(f"{self._path}: {layer}: record {number}: expected {missing}")
        return rows

    def _known(self, table: Mapping[str, Any], layer: str, token: Any) -> Any:
        if not isinstance(token, str) or token not in table:
            raise InputError(f"{self._path}: {layer}: unknown token {token!r}")
        return table[token]

    def _points(self, layer: str, tokens: Sequence[str]) -> FloatArray:
        points = [self._known(self._nodes, layer, token) for token in tokens]
        try:
            array = np.array(points, dtype=np.float64).reshape(-1, 2)
        except (TypeError, ValueError) as error:
            raise InputError(f"{self._path}: node: expected numbers: {error}") from error
        if not np.isfinite(array).all():
            raise InputError(f"{self._path}: node: expected finite numbers")
        return array

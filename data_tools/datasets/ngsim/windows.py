"""NGSIM traffic in short windows: `windows.csv.gz` and `maps.json.gz`, in; recorded traffic with its road, out.

    windows.csv[.gz]    site, scenario, id, step, type, x, y, yaw, speed, accel, length, width; columns in any order
                        a vehicle at a step of 0.1 s; m, rad, m/s; an id means something within its scenario only
    maps.json[.gz]      scenario -> lanelets, lights (see `data_tools.datasets.ngsim.road`)

A recording is a scenario; its coordinates are those of the scenario's map. Velocities are the recorded speed along the
yaw. Nothing is smoothed, and vehicles that overlap, as noise makes them do in places, stay as they are.

Source: Next Generation Simulation, US DOT, https://ops.fhwa.dot.gov/trafficanalysistools/ngsim.htm; windows and maps as
scenarios of CommonRoad (Althoff, Koschi and Manzinger, CommonRoad, IEEE IV 2017).
"""

from __future__ import annotations

import gzip
import json
import zlib
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from data_tools.datasets.ngsim.road import road_of
from data_tools.datasets.recorded_traffic import RecordedTraffic, StateRows
from data_tools.files.error_messages import unknown_name
from data_tools.files.input_files import read_bytes
from data_tools.files.text_tables import TextTable
from saga_fg.errors import InputError
from saga_fg.types.boxes import MAX_POSITION, MAX_SIZE, MAX_SPEED

Road = Literal["signals", "map", "none"]
WINDOWS, MAPS = ("windows.csv.gz", "windows.csv"), ("maps.json.gz", "maps.json")
COLUMNS = ("scenario", "id", "step", "type", "x", "y", "yaw", "speed", "length", "width")
_NUMBERS = ("x", "y", "yaw", "speed", "length", "width")
_LARGEST = (MAX_POSITION, MAX_POSITION, 1e3, MAX_SPEED, MAX_SIZE, MAX_SIZE)
_STEPS = 1_000_000  # largest step


class NgsimWindows:
    """The windows in a folder. `road`: with map and colours of the lights, with the map alone, or with neither.

    Raises `InputError` for a folder without windows, and for a table that is not as above.
    """

    def __init__(self, root: str | Path, road: Road = "signals") -> None:
        self._root, self._road = Path(root), road
        path = _existing(self._root, WINDOWS)
        self._table = _read_windows(path)
        scenario = self._table.values[:, 0]
        self._rows = {str(name): np.flatnonzero(scenario == name) for name in dict.fromkeys(scenario.tolist())}

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the windows, in the order of the table."""
        return tuple(self._rows)

    def recording(self, name: str) -> RecordedTraffic:
        """Read a window; raises `InputError` for an unknown name, a broken row, and a window without a map."""
        if name not in self._rows:
            raise InputError(f"{self._root}: {unknown_name('window', name, self.names)}")
        rows = self._rows[name]
        table = TextTable(self._table.path, self._table.values[rows], self._table.line[rows])
        step = table.integers(2, "step", 0, _STEPS)
        numbers = table.numbers(slice(4, None), _NUMBERS, _LARGEST)
        low = numbers[:, 3:] < np.array([0.0, 1e-3, 1e-3])
        if low.any():
            row, column = (int(i) for i in np.argwhere(low)[0])
            least = "of at least 0" if column == 0 else "above 0"
            raise table.fault(row, f"{_NUMBERS[3 + column]}: expected a number {least}, got {numbers[row, 3 + column]}")
        yaw, speed = numbers[:, 2], numbers[:, 3]
        velocity = speed[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)])
        vehicle, label = table.values[:, 1], np.char.lower(table.values[:, 3])
        of_vehicle = zip(vehicle.tolist(), zip(label.tolist(), *numbers[:, 4:].T.tolist(), strict=True), strict=True)
        first = int(step.min())
        states = StateRows(step - first, vehicle, numbers[:, :2], velocity, yaw)
        traffic = states.traffic(f"{table.path}: {name}", dict(of_vehicle))
        traffic = replace(traffic, name=name)
        if self._road == "none":
            return traffic
        path, maps = self._maps
        if name not in maps:
            raise InputError(f"{path}: {name}: expected a map, there is none; --road none goes without")
        road, cycles = road_of(maps[name], f"{path}: {name}", with_cycles=self._road == "signals")
        steps = first + np.arange(len(traffic))
        colours = {light: cycle(steps) for light, cycle in cycles.items()}
        return replace(traffic, road_map=road, colours=colours)

    @cached_property
    def _maps(self) -> tuple[Path, dict[str, Any]]:
        path = _existing(self._root, MAPS, "; --road none goes without")
        try:
            maps = json.loads(_read_text(path))
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path}: expected JSON: {error}") from error
        if not isinstance(maps, dict):
            raise InputError(f"{path}: expected maps by scenario, got {type(maps).__name__}")
        return path, maps


def _read_windows(path: Path) -> TextTable:
    """The columns of `COLUMNS`, in their order, of all rows."""
    header, *lines = _read_text(path).splitlines() or [""]
    there = [name.strip() for name in header.split(",")]
    missing = next((name for name in COLUMNS if name not in there), None)
    if missing is not None:
        raise InputError(f"{path}: {missing}: expected this column, the file has {', '.join(there)[:200] or 'none'}")
    at = [there.index(name) for name in COLUMNS]
    rows, numbers = [], []
    for number, line in enumerate(lines, start=2):
        if not line.strip():
            continue
        row = line.split(",")
        if len(row) != len(there):
            raise InputError(f"{path}: line {number}: expected {len(there)} columns, got {len(row)}")
        rows.append([row[k].strip() for k in at])
        numbers.append(number)
    if not rows:
        raise InputError(f"{path}: expected rows, there are none")
    table = TextTable.of(path, rows, numbers, len(COLUMNS))
    unnamed = (table.values[:, [0, 1, 3]] == "").any(axis=1)
    if unnamed.any():
        raise table.fault(int(np.argmax(unnamed)), "scenario, id, type: expected a value")
    return table


def _existing(root: Path, names: tuple[str, ...], otherwise: str = "") -> Path:
    """The first of the files that is there."""
    found = next((root / name for name in names if (root / name).is_file()), None)
    if found is None:
        raise InputError(f"{root}: expected {' or '.join(names)}, there is neither{otherwise}")
    return found


def _read_text(path: Path) -> str:
    content = read_bytes(path)
    try:
        return (gzip.decompress(content) if path.suffix == ".gz" else content).decode("utf-8")
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected text in UTF-8, compressed by gzip if it ends in .gz: {error}") from error

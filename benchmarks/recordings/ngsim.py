"""NGSIM traffic in short windows: `windows.csv.gz` and `maps.json.gz`, in; recorded traffic with its road, out.

    windows.csv[.gz]    site, scenario, id, step, type, x, y, yaw, speed, accel, length, width; columns in any order
                        a vehicle at a step of 0.1 s; m, rad, m/s; an id means something within its scenario only
    maps.json[.gz]      scenario -> lanelets, lights (see `benchmarks.recordings.lanelets`)

A recording is a scenario; its coordinates are those of the scenario's map. Velocities are the recorded speed along the
yaw. Nothing is smoothed, and vehicles that overlap, as noise makes them do in places, stay as they are.

Source: Next Generation Simulation, US DOT, https://ops.fhwa.dot.gov/trafficanalysistools/ngsim.htm; windows and maps as
scenarios of CommonRoad (Althoff, Koschi and Manzinger, CommonRoad, IEEE IV 2017).
"""

from __future__ import annotations

import gzip
import json
import zlib
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from benchmarks.recordings.lanelets import road_of
from benchmarks.recordings.traffic import RecordedTraffic, Recordings, on_grid
from data_tools.files import TextTable, read_bytes
from saga_fg.errors import InputError
from saga_fg.types import MAX_POSITION, MAX_SIZE, MAX_SPEED

Road = Literal["signals", "map", "none"]
WINDOWS, MAPS = ("windows.csv.gz", "windows.csv"), ("maps.json.gz", "maps.json")
_NUMBERS = ("x", "y", "yaw", "speed", "length", "width")
COLUMNS = ("scenario", "id", "type", "step", *_NUMBERS)
_LARGEST = (MAX_POSITION, MAX_POSITION, 1e3, MAX_SPEED, MAX_SIZE, MAX_SIZE)
_STEPS = 1_000_000  # largest step


def ngsim_windows(root: Path, road: Road = "signals") -> Recordings:
    """The windows in a folder. `road`: with map and colours of the lights, with the map alone, or with neither.

    Raises `InputError` for a folder without windows, and for a table that is not as above.
    """
    whole = _windows(root)
    scenario = whole.values[:, 0]
    maps = cache(_maps)

    def read(name: str) -> RecordedTraffic:
        rows = scenario == name
        if not rows.any():
            raise InputError(f"{whole.path}: scenario: expected rows of {name!r}, there are none")
        table = TextTable(whole.path, whole.values[rows], whole.line[rows])
        step = table.integers(3, "step", 0, _STEPS)
        numbers = table.numbers(slice(4, None), _NUMBERS, _LARGEST)
        for column, least, expected in ((3, 0.0, "of at least 0"), (4, 1e-3, "above 0"), (5, 1e-3, "above 0")):
            low = numbers[:, column] < least
            if low.any():
                got = f"expected a number {expected}, got {numbers[low, column][0]}"
                raise table.fault(int(np.argmax(low)), f"{_NUMBERS[column]}: {got}")
        yaw, speed = numbers[:, 2], numbers[:, 3]
        velocity = speed[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)])
        sizes = zip(np.char.lower(table.values[:, 2]).tolist(), *numbers[:, 4:].T.tolist(), strict=True)
        of_vehicle = dict(zip(table.values[:, 1].tolist(), sizes, strict=True))
        states = numbers[:, :2], velocity, yaw
        what = f"{table.path}: {name}"
        traffic = replace(on_grid(what, step - step.min(), table.values[:, 1], states, of_vehicle), name=name)
        if road == "none":
            return traffic
        path, entries = maps(root)
        if name not in entries:
            raise InputError(f"{path}: {name}: expected a map, there is none; --road none goes without")
        steps = int(step.min()) + np.arange(len(traffic)) if road == "signals" else None
        road_map, colours = road_of(entries[name], f"{path}: {name}", steps)
        return replace(traffic, road_map=road_map, colours=colours)

    return Recordings(tuple(dict.fromkeys(scenario.tolist())), read)


def _maps(root: Path) -> tuple[Path, dict[str, Any]]:
    path, text = text_of(root, MAPS, "; --road none goes without")
    try:
        maps = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: expected JSON: {error}") from error
    if not isinstance(maps, dict):
        raise InputError(f"{path}: expected maps by scenario, got {type(maps).__name__}")
    return path, maps


def _windows(root: Path) -> TextTable:
    """The columns of `COLUMNS`, in their order, of all rows."""
    table = named_columns(*text_of(root, WINDOWS), COLUMNS)
    unnamed = (table.values[:, :3] == "").any(axis=1)
    if unnamed.any():
        raise table.fault(int(np.argmax(unnamed)), "scenario, id, type: expected a value")
    return table


def named_columns(path: Path, text: str, columns: Sequence[str]) -> TextTable:
    """Some columns, in their order, of the rows of a table with a header; raises `InputError` for one without them."""
    rows = [[value.strip() for value in line.split(",")] for line in text.splitlines()] or [[""]]
    there = rows[0]
    missing = next((name for name in columns if name not in there), None)
    if missing is not None:
        raise InputError(f"{path}: {missing}: expected this column, the file has {', '.join(there)[:200] or 'none'}")
    found = {number: row for number, row in enumerate(rows[1:], start=2) if any(row)}
    for number, row in found.items():
        if len(row) != len(there):
            raise InputError(f"{path}: line {number}: expected {len(there)} columns, got {len(row)}")
    if not found:
        raise InputError(f"{path}: expected rows, there are none")
    at = [there.index(name) for name in columns]
    return TextTable.from_rows(path, [[row[k] for k in at] for row in found.values()], list(found))


def text_of(root: Path, names: tuple[str, ...], otherwise: str = "") -> tuple[Path, str]:
    """The first of the files that is there, and what it says."""
    path = next((root / name for name in names if (root / name).is_file()), None)
    if path is None:
        raise InputError(f"{root}: expected {' or '.join(names)}, there is neither{otherwise}")
    content = read_bytes(path)
    try:
        return path, (gzip.decompress(content) if path.suffix == ".gz" else content).decode("utf-8")
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected text in UTF-8, compressed by gzip if it ends in .gz: {error}") from error

"""Tracks written as a table, a row per track and moment: CSV or newline-delimited JSON. Columns: see the package."""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.files.atomic_files import atomic_file
from data_tools.files.error_messages import error_context
from data_tools.files.input_files import open_bytes
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import upper_triangle
from saga_fg.types.dataset import Scene
from saga_fg.types.track import Tracks

TRACK_COLUMNS = (
    *("scene", "timestamp", "id", "label", "x", "y", "z", "length", "width", "height", "yaw", "vx", "vy", "score"),
    *("cov_xx", "cov_xy", "cov_yy", "cov_vxvx", "cov_vxvy", "cov_vyvy", "coasting"),
)
SETTLED = "settled"  # 1 or 0, the last column of results


def write_tracks(path: str | Path, scenes: Iterable[tuple[Scene, Sequence[Tracks]]]) -> None:
    """Write the tracks of some scenes, each with one `Tracks` for each of its timestamps, to .csv, .ndjson or .jsonl.

    `scenes` may be a generator: the file appears when all is done. What is unknown is left empty (CSV) or out (JSON);
    numbers are written in full. Raises `InputError` for another suffix, a path that is not writable, and tracks that
    do not fit the scene.
    """
    write_rows(path, (*TRACK_COLUMNS, SETTLED), _result_rows(str(path), scenes))


def write_rows(path: str | Path, columns: tuple[str, ...], rows: Iterable[list[Any]]) -> None:
    """Write a table to .csv, .ndjson or .jsonl; None is left empty (CSV) or out (JSON).

    Raises `InputError` for another suffix and a path that is not writable.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (".csv", ".ndjson", ".jsonl"):
        raise InputError(f"{path}: expected a file name that ends in .csv, .ndjson, .jsonl")
    with atomic_file(path) as binary:
        file = io.TextIOWrapper(binary, encoding="utf-8", newline="", write_through=True)
        if suffix == ".csv":
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(columns)
            writer.writerows(rows)
        else:
            for row in rows:
                known = {name: value for name, value in zip(columns, row, strict=True) if value is not None}
                file.write(json.dumps(known, allow_nan=False) + "\n")
        file.detach()


def merge_tables(path: Path, parts: Iterable[Path]) -> None:
    """Write the rows of several CSV tables with the same columns into one. Raises `InputError` where that fails."""
    with atomic_file(path) as file:
        for number, part in enumerate(parts):
            with open_bytes(part) as table:
                header = table.readline()
                file.write(b"" if number else header)
                shutil.copyfileobj(table, file)


def track_rows(path: str, scenes: Iterable[tuple[Scene, Sequence[Tracks]]]) -> Iterator[list[Any]]:
    """The rows of `TRACK_COLUMNS`, None for what is unknown; `path` is named where tracks do not fit their scene."""
    for scene, moments in scenes:
        with error_context(f"{path}: scene {scene.name}"):
            if len(moments) != len(scene):
                raise InputError(f"expected tracks for {len(scene)} moments, got {len(moments)}")
        for timestamp, tracks in zip(scene.timestamps.tolist(), moments, strict=True):
            boxes = tracks.boxes
            before = np.column_stack([boxes.position, boxes.size, boxes.yaw, boxes.velocity, tracks.score])
            covariances = (tracks.position_covariance, tracks.velocity_covariance)
            after = np.column_stack([*(upper_triangle(P) for P in covariances), tracks.coasting])
            for id_, label, *numbers in zip(
                tracks.id.tolist(), boxes.label.tolist(), *np.hstack([before, after]).T.tolist(), strict=True
            ):
                yield [scene.name, timestamp, id_, label, *(None if x != x else x for x in numbers)]


def _result_rows(path: str, scenes: Iterable[tuple[Scene, Sequence[Tracks]]]) -> Iterator[list[Any]]:
    """The rows of `track_rows` with the last column of results."""
    for scene, moments in scenes:
        settled = np.concatenate([np.empty(0, dtype=bool), *(tracks.settled for tracks in moments)])
        rows = track_rows(path, [(scene, moments)])
        yield from ([*row, value] for row, value in zip(rows, settled.astype(int).tolist(), strict=True))

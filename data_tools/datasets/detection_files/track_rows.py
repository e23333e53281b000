"""Tables of tracks read back: a row per track and moment. See the package for the columns."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_tools.datasets.detection_files.columns import RawTable
from data_tools.datasets.detection_files.dataset import box_columns
from data_tools.datasets.detection_files.formats import Layout, read_raw_table
from data_tools.datasets.detection_files.tracks import TRACK_COLUMNS
from saga_fg.numerics.arrays import FloatArray, StrArray, from_upper_triangle
from saga_fg.types.boxes import Boxes

REQUIRED = ("timestamp", "id", "x", "y")
LARGEST_ID = 2**53  # beyond, doubles leave integers out


@dataclass(frozen=True, eq=False)
class TrackRows:
    """N rows of a table of tracks, in the order of the file; NaN in covariances and coasting for what is left out.

    scene (N,), timestamp (N,) in s, id (N,), boxes in world coordinates, score (N,), position_covariance (N, 2, 2) in
    m^2, velocity_covariance (N, 2, 2) in (m/s)^2, coasting (N,) in s
    """

    scene: StrArray
    timestamp: FloatArray
    id: StrArray
    boxes: Boxes
    score: FloatArray
    position_covariance: FloatArray
    velocity_covariance: FloatArray
    coasting: FloatArray


def read_tracks(path: str | Path) -> TrackRows:
    """Read a table of tracks, .csv, .ndjson or .jsonl. Raises `InputError` naming file, row and column."""
    return track_rows_of(read_raw_table(Path(path), Layout(TRACK_COLUMNS, REQUIRED)))


def track_rows_of(raw: RawTable) -> TrackRows:
    """The tracks in a table that may have further columns."""
    found = box_columns(raw, np.zeros(raw.length, dtype=np.bool_))
    timestamp = raw.numbers("timestamp")
    for name, column in (("timestamp", timestamp), ("id", id_ := raw.numbers("id"))):
        if np.isnan(column).any():
            raise raw.fault(int(np.argmax(np.isnan(column))), f"{name}: expected a number, got none")
    strange = (np.abs(id_) > LARGEST_ID) | (id_ != np.floor(id_))
    if strange.any():
        row = int(np.argmax(strange))
        raise raw.fault(row, f"id: expected an integer of at most {LARGEST_ID}, got {id_[row]:g}")
    return TrackRows(
        raw.texts("scene", raw.path.stem),
        timestamp,
        id_.astype(np.int64).astype(np.str_),
        found.boxes,
        found.score,
        _covariance(raw, ("cov_xx", "cov_xy", "cov_yy")),
        _covariance(raw, ("cov_vxvx", "cov_vxvy", "cov_vyvy")),
        raw.numbers("coasting"),
    )


def _covariance(raw: RawTable, names: tuple[str, str, str]) -> FloatArray:
    return from_upper_triangle(np.stack([raw.numbers(name) for name in names], axis=-1))

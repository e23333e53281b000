"""Tables of tracks read back: a row per track and moment. See the package for the columns."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from data_tools.datasets.detection_files.columns import QUATERNION, RawTable
from data_tools.datasets.detection_files.dataset import box_columns
from data_tools.datasets.detection_files.formats import Layout, read_raw_table
from data_tools.datasets.detection_files.table_import import TableImport
from data_tools.datasets.detection_files.tracks import SETTLED, TRACK_COLUMNS
from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray, from_upper_triangle
from saga_fg.types.boxes import Boxes

REQUIRED = ("timestamp", "id", "x", "y")
OWN = frozenset({"timestamp", "id", "x", "y", "cov_xx", "coasting"})  # columns of a table that saga-fg wrote
NUMBERS = tuple(name for name in TRACK_COLUMNS if name not in ("scene", "id", "label"))


@dataclass(frozen=True, eq=False)
class TrackRows:
    """N rows of a table of tracks, in the order of the file; NaN in covariances and coasting for what is left out.

    scene (N,), timestamp (N,) in s, id (N,), boxes in world coordinates, score (N,), position_covariance (N, 2, 2) in
    m^2, velocity_covariance (N, 2, 2) in (m/s)^2, coasting (N,) in s; named: whether the table names its scenes
    """

    scene: StrArray
    timestamp: FloatArray
    id: StrArray
    boxes: Boxes
    score: FloatArray
    position_covariance: FloatArray
    velocity_covariance: FloatArray
    coasting: FloatArray
    named: bool = True

    def select(self, rows: IntArray) -> TrackRows:
        """Some of the rows."""
        return replace(
            self,
            **{f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name not in ("boxes", "named")},
            boxes=self.boxes.select(rows),
        )


def read_tracks(path: str | Path, how: TableImport | None = None, lenient: bool = False) -> TrackRows:
    """Read a table of tracks in any of the formats of detections. Raises `InputError` naming file, row and column.

    how      what it takes to understand it, without effect on a table that saga-fg wrote
    lenient  columns that `how` names need not be there
    """
    layout = Layout((*TRACK_COLUMNS, SETTLED, *QUATERNION), REQUIRED, lenient)
    return track_rows_of(read_raw_table(Path(path), layout, how, own=OWN))


def track_rows_of(raw: RawTable) -> TrackRows:
    """The tracks in a table that may have further columns; without those of classes that are to be left out."""
    raw.check_numbers(NUMBERS)
    _, left_out = raw.labels()
    kept = np.flatnonzero(~left_out)
    found = box_columns(raw, left_out)
    raw.warn_of_doubts()
    timestamp = raw.numbers("timestamp")
    if np.isnan(timestamp).any():
        row = int(np.argmax(np.isnan(timestamp)))
        raise raw.fault(row, f"{raw.title('timestamp')}: expected a number, got none")
    return TrackRows(
        raw.texts("scene", raw.path.stem)[kept],
        timestamp[kept],
        raw.identities("id")[kept],
        found.boxes.select(kept),
        found.score[kept],
        _covariance(raw, ("cov_xx", "cov_xy", "cov_yy"))[kept],
        _covariance(raw, ("cov_vxvx", "cov_vxvy", "cov_vyvy"))[kept],
        raw.numbers("coasting")[kept],
        "scene" in raw.columns,
    )


def _covariance(raw: RawTable, names: tuple[str, str, str]) -> FloatArray:
    return from_upper_triangle(np.stack([raw.numbers(name) for name in names], axis=-1))

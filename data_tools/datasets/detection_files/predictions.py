"""Predicted tracks as a table beside the tracks: a row per track, moment and horizon, CSV.

scene, timestamp      of the moment from which the track is predicted, as in the table of tracks
horizon               s after it
id, label             of the track
x, y, yaw, vx, vy     predicted mean, world: m, rad, m/s
cov_xx, ..., cov_vyvy covariances of position, m^2, and velocity, (m/s)^2
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from data_tools.datasets.detection_files.formats import Layout, read_raw_table
from data_tools.files.atomic_files import atomic_file
from saga_fg.numerics.arrays import FloatArray, StrArray, from_upper_triangle, upper_triangle
from saga_fg.numerics.columns import Columns
from saga_fg.types.predicted_tracks import PredictedTracks

_NAMES = ("scene", "timestamp", "horizon", "id", "label")
_POSITION_COVARIANCE = ("cov_xx", "cov_xy", "cov_yy")
PREDICTION_COLUMNS = (
    *(*_NAMES, "x", "y", "yaw", "vx", "vy", *_POSITION_COVARIANCE),
    *("cov_vxvx", "cov_vxvy", "cov_vyvy"),
)
SUFFIX = ".predictions.csv"


@dataclass(frozen=True, eq=False)
class PredictionRows(Columns):
    """R predicted positions.

    timestamp (R,) of the moment, s; horizon (R,), s; id (R,); position (R, 2), m; covariance (R, 2, 2), m^2
    """

    timestamp: FloatArray
    horizon: FloatArray
    id: StrArray
    position: FloatArray
    covariance: FloatArray

    @classmethod
    def of(cls, moments: Sequence[PredictedTracks]) -> Self:
        """The rows of what was predicted at several moments."""
        each = [cls._of_moment(predicted) for predicted in moments]
        none = np.empty(0)
        empty = cls(none, none, np.empty(0, dtype=np.str_), np.empty((0, 2)), np.empty((0, 2, 2)))
        return cls(
            *(
                np.concatenate([getattr(rows, name) for rows in (empty, *each)])
                for name in ("timestamp", "horizon", "id", "position", "covariance")
            )
        )

    @classmethod
    def _of_moment(cls, predicted: PredictedTracks) -> Self:
        h, n = len(predicted.horizons), len(predicted)
        return cls(
            np.full(h * n, predicted.timestamp),
            np.repeat(predicted.horizons, n),
            np.tile(predicted.id.astype(np.str_), h),
            predicted.position.reshape(-1, 2),
            predicted.position_covariance.reshape(-1, 2, 2),
        )


@contextmanager
def prediction_writer(path: Path) -> Iterator[Callable[[str, Sequence[PredictedTracks]], None]]:
    """Yield a function that appends what was predicted in a scene; the file appears at the end of the block.

    Raises `InputError` for a path that is not writable.
    """
    with atomic_file(path) as binary:
        file = io.TextIOWrapper(binary, encoding="utf-8", newline="", write_through=True)
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(PREDICTION_COLUMNS)
        yield lambda scene, moments: writer.writerows(row for each in moments for row in _rows(scene, each))
        file.detach()


def _rows(scene: str, predicted: PredictedTracks) -> Iterator[list[Any]]:
    names = list(zip(predicted.id.tolist(), predicted.label.tolist(), strict=True))
    for k, horizon in enumerate(predicted.horizons.tolist()):
        covariances = (predicted.position_covariance[k], predicted.velocity_covariance[k])
        numbers = np.column_stack(
            [
                *(predicted.position[k], predicted.yaw[k], predicted.velocity[k]),
                *(upper_triangle(P) for P in covariances),
            ]
        )
        for (id_, label), row in zip(names, numbers.tolist(), strict=True):
            yield [scene, predicted.timestamp, horizon, id_, label, *(None if x != x else round(x, 4) for x in row)]


def predictions_path(result: Path) -> Path:
    """The table of predictions beside a result, a file or a folder."""
    return result.with_name(f"{result.name}{SUFFIX}")


def read_predictions(result: Path) -> dict[str, PredictionRows]:
    """The predictions kept with a result, by scene; none where the run kept none.

    They are in one table, or after a parallel run in a table for each part. Raises `InputError` for a broken table.
    """
    whole = predictions_path(result)
    parts = [whole] if whole.is_file() else sorted(result.with_suffix("").glob(f"*{SUFFIX}"))
    found: dict[str, PredictionRows] = {}
    for path in parts:
        found |= _read_table(path)
    return found


def _read_table(path: Path) -> dict[str, PredictionRows]:
    numbers = ("timestamp", "horizon", "id", "x", "y")
    raw = read_raw_table(path, Layout(PREDICTION_COLUMNS, numbers))
    columns = {name: raw.numbers(name) for name in (*numbers, *_POSITION_COVARIANCE)}
    for name in numbers:
        if np.isnan(columns[name]).any():
            raise raw.fault(int(np.argmax(np.isnan(columns[name]))), f"{name}: expected a number, got none")
    rows = PredictionRows(
        columns["timestamp"],
        columns["horizon"],
        columns["id"].astype(np.int64).astype(np.str_),
        np.stack([columns["x"], columns["y"]], axis=-1),
        from_upper_triangle(np.stack([columns[name] for name in _POSITION_COVARIANCE], axis=-1)),
    )
    scene = raw.texts("scene", Path(path.name.removesuffix(SUFFIX)).stem)
    return {str(name): rows.select(np.flatnonzero(scene == name)) for name in np.unique(scene)}

"""Labels as one table, a row per box: CSV, newline-delimited JSON or Parquet, by the suffix.

The columns are those of a table of tracks (see `data_tools.datasets.detection_files`), which its reader reads too, and
besides

    yaw_variance   of the heading, rad^2
    source         observed, filled or extended
    quality        high, medium or low
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.datasets.detection_files import TRACK_COLUMNS, TrackRows, track_rows, write_rows
from data_tools.datasets.detection_files.formats import Layout, read_raw_table
from data_tools.datasets.detection_files.tracks import REQUIRED, track_rows_of
from data_tools.datasets.source import LabelledScenes
from data_tools.files.atomic_files import atomic_file
from saga_fg.errors import MissingExtraError
from saga_fg.numerics.arrays import FloatArray, StrArray

LABEL_COLUMNS = (*TRACK_COLUMNS, "yaw_variance", "source", "quality")
ROWS_AT_A_TIME = 65536  # of a Parquet file


@dataclass(frozen=True, eq=False)
class LabelRows:
    """N rows of a table of labels: their tracks, yaw_variance (N,) NaN where unknown, source (N,), quality (N,)."""

    tracks: TrackRows
    yaw_variance: FloatArray
    source: StrArray
    quality: StrArray


def write_label_table(path: str | Path, scenes: LabelledScenes) -> None:
    """Write the labels of some scenes, each with one `Labels` for each of its timestamps.

    `scenes` may be a generator: the file appears when all is done. Raises `InputError` for another suffix than .csv,
    .ndjson, .jsonl, .parquet, a path that is not writable, and labels that do not fit the scene; `MissingExtraError`
    for Parquet without its extra.
    """
    rows = _rows(str(path), scenes)
    if Path(path).suffix.lower() == ".parquet":
        _write_parquet(path, LABEL_COLUMNS, rows, texts=("scene", "label", "source", "quality"))
    else:
        write_rows(path, LABEL_COLUMNS, rows)


def read_label_table(path: str | Path) -> LabelRows:
    """Read a table of labels, .csv, .ndjson or .jsonl; a table of tracks counts as observed, of quality low.

    Raises `InputError` naming file, row and column.
    """
    raw = read_raw_table(Path(path), Layout(LABEL_COLUMNS, REQUIRED))
    return LabelRows(
        track_rows_of(raw), raw.numbers("yaw_variance"), raw.texts("source", "observed"), raw.texts("quality", "low")
    )


def _rows(path: str, scenes: LabelledScenes) -> Iterator[list[Any]]:
    for scene, frames in scenes:
        tracks = [labels.tracks for labels in frames]
        variance = np.concatenate([np.empty(0), *(labels.yaw_variance for labels in frames)])
        source = np.concatenate([np.empty(0, dtype="<U1"), *(labels.source for labels in frames)])
        quality = np.concatenate([np.empty(0, dtype="<U1"), *(labels.quality for labels in frames)])
        extra = zip(variance.tolist(), source.tolist(), quality.tolist(), strict=True)
        for row, (v, s, q) in zip(track_rows(path, [(scene, tracks)]), extra, strict=True):
            yield [*row, None if v != v else v, s, q]


def _write_parquet(
    path: str | Path, columns: tuple[str, ...], rows: Iterable[list[Any]], texts: tuple[str, ...]
) -> None:
    """Write rows as they come; columns in `texts` are text, id is a whole number, all others numbers, None is null.

    Raises `MissingExtraError` without pyarrow, `InputError` for a path that is not writable.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise MissingExtraError(f"{path}: Parquet needs pyarrow: pip install 'saga-fg[parquet]'") from error
    kinds = {name: pa.string() if name in texts else pa.int64() if name == "id" else pa.float64() for name in columns}
    schema = pa.schema(list(kinds.items()))
    source = iter(rows)
    with atomic_file(path) as file, pq.ParquetWriter(file, schema) as writer:
        while block := list(islice(source, ROWS_AT_A_TIME)):
            writer.write_table(pa.table(dict(zip(columns, zip(*block, strict=True), strict=True)), schema=schema))

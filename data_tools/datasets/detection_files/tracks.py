"""Tables of tracks, labels and predicted tracks, written and read back: a row per box.

Tables of labels have the columns of tracks and

    yaw_variance   of the heading, rad^2
    source         observed, filled or extended
    quality        high, medium or low
    p_exists, p_class, p_identity, p_heading  probabilities that the label is right

Predicted tracks as a table beside the tracks: a row per track, moment and horizon, CSV.

scene, timestamp      of the moment from which the track is predicted, as in the table of tracks
horizon               s after it
id, label             of the track
x, y, yaw, vx, vy     predicted mean, world: m, rad, m/s
cov_xx, ..., cov_vyvy covariances of position, m^2, and velocity, (m/s)^2
"""

from __future__ import annotations

import csv
import io
import json
import logging
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from data_tools.datasets.detection_files.formats import Layout, read_raw_table
from data_tools.files import atomic_file, open_bytes
from saga_fg.errors import InputError, error_context, require_extra
from saga_fg.numerics import (
    Columns,
    FloatArray,
    StrArray,
    from_upper_triangle,
    refuse,
)
from saga_fg.tables import (
    LABEL_COLUMNS,
    PROBABILITIES,
    QUATERNION,
    REVIEW_COLUMNS,
    SETTLED,
    TRACK_COLUMNS,
    RawTable,
    Sample,
    TableImport,
    box_columns,
    findings_of,
    option_text,
)
from saga_fg.types import (
    POSITION_COVARIANCE,
    VELOCITY_COVARIANCE,
    Boxes,
    Finding,
    PredictedTracks,
    Scene,
    Tracks,
    refuse_contradictions,
)

if TYPE_CHECKING:
    from saga_fg.smoothing import Labels, Review

log = logging.getLogger(__name__)

TEXTS = ("scene", "sensor", "label", "source", "quality")
WHOLE = ("id", SETTLED)
ROWS_AT_A_TIME = 65536  # of a Parquet file


def write_tracks(path: str | Path, scenes: Iterable[tuple[Scene, Sequence[Tracks]]]) -> None:
    """Write the tracks of some scenes, each with one `Tracks` for each of its timestamps, as `write_rows` does.

    `scenes` may be a generator: the file appears when all is done; numbers are written in full. Raises `InputError` for
    another suffix, a path that is not writable, and tracks that do not fit the scene.
    """
    _write_scenes(path, scenes, (*TRACK_COLUMNS, SETTLED))


def write_label_table(path: str | Path, scenes: Iterable[tuple[Scene, Sequence[Labels]]]) -> None:
    """Write the labels of some scenes, each with one `Labels` for each of its timestamps; else as `write_tracks`."""
    _write_scenes(path, scenes, LABEL_COLUMNS)


def write_review(path: str | Path, reviews: Mapping[str, Review]) -> None:
    """Write the objects of scenes by name, those first that are most worth a look; else as `write_tracks`."""
    tables = {name: review.table_columns() for name, review in reviews.items()}
    rows = [
        [name, *row]
        for name, table in tables.items()
        for row in zip(*(c.tolist() for c in table.values()), strict=True)
    ]
    write_rows(path, REVIEW_COLUMNS, sorted(rows, key=lambda row: -row[1]))


def _write_scenes(
    path: str | Path, scenes: Iterable[tuple[Scene, Sequence[Tracks | Labels]]], columns: tuple[str, ...]
) -> None:
    rows = (row for scene, moments in scenes for row in _rows(str(path), scene, moments, columns))
    write_rows(path, columns, rows)


def _rows(path: str, scene: Scene, moments: Sequence[Tracks | Labels], columns: tuple[str, ...]) -> Iterator[list[Any]]:
    """The rows of a scene, None for what is unknown; `path` is for errors."""
    if len(moments) != len(scene):
        raise InputError(f"{path}: scene {scene.name}: expected tracks for {len(scene)} moments, got {len(moments)}")
    for time, moment in zip(scene.timestamps.tolist(), moments, strict=True):
        table = moment.table_columns()
        n = len(table["id"])
        table |= {"scene": np.full(n, scene.name), "timestamp": np.full(n, time), SETTLED: table[SETTLED].astype(int)}
        for row in zip(*(table[name].tolist() for name in columns), strict=True):
            yield [None if value != value else value for value in row]


def write_rows(path: str | Path, columns: tuple[str, ...], rows: Iterable[list[Any]]) -> None:
    """Write a table to .csv, .ndjson, .jsonl or .parquet; None is left empty (CSV), out (JSON) or null (Parquet).

    Raises `InputError` for another suffix and a path that is not writable, `MissingExtraError` for Parquet without its
    extra.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (".csv", ".ndjson", ".jsonl", ".parquet"):
        raise InputError(f"{path}: expected a file name that ends in .csv, .ndjson, .jsonl, .parquet")
    if suffix == ".parquet":
        _write_parquet(path, columns, iter(rows))
        return
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


def _write_parquet(path: str | Path, columns: tuple[str, ...], rows: Iterator[list[Any]]) -> None:
    """Write rows as they come: `TEXTS` as text, `WHOLE` as whole numbers, all other columns as numbers."""
    require_extra("parquet", f"{path}: Parquet", "pyarrow")
    import pyarrow as pa
    import pyarrow.parquet as pq

    kinds = dict.fromkeys(TEXTS, pa.string()) | dict.fromkeys(WHOLE, pa.int64())
    schema = pa.schema([(name, kinds.get(name, pa.float64())) for name in columns])
    with atomic_file(path) as file, pq.ParquetWriter(file, schema) as writer:
        while block := list(islice(rows, ROWS_AT_A_TIME)):
            writer.write_table(pa.table(dict(zip(columns, zip(*block, strict=True), strict=True)), schema=schema))


def merge_tables(path: Path, parts: Iterable[Path]) -> None:
    """Write the rows of several CSV tables with the same columns into one. Raises `InputError` where that fails."""
    with atomic_file(path) as file:
        for number, part in enumerate(parts):
            with open_bytes(part) as table:
                header = table.readline()
                file.write(b"" if number else header)
                shutil.copyfileobj(table, file)


TRACK_REQUIRED = ("timestamp", "id", "x", "y")
OWN = frozenset({"timestamp", "id", "x", "y", "cov_xx", "coasting"})  # columns of a table that saga-fg wrote
NUMBERS = tuple(name for name in TRACK_COLUMNS if name not in ("scene", "id", "label"))


@dataclass(frozen=True, eq=False)
class TrackRows(Columns):
    """N rows of a table of tracks or labels, in the order of the file; NaN for what is left out of numbers.

    scene (N,), timestamp (N,) in s, id (N,), boxes in world coordinates, score (N,), position_covariance (N, 2, 2) in
    m^2, velocity_covariance (N, 2, 2) in (m/s)^2, coasting (N,) in s; of labels: yaw_variance (N,) in rad^2,
    source (N,), quality (N,), "observed" and "low" where left out, probability (N, 4)
    by `PROBABILITIES`; named: whether the table names its scenes
    """

    scene: StrArray
    timestamp: FloatArray
    id: StrArray
    boxes: Boxes
    score: FloatArray
    position_covariance: FloatArray
    velocity_covariance: FloatArray
    coasting: FloatArray
    yaw_variance: FloatArray
    source: StrArray
    quality: StrArray
    probability: FloatArray
    named: bool = True

    @classmethod
    def from_columns(
        cls,
        scene: StrArray,
        timestamp: FloatArray,
        id_: StrArray,
        boxes: Boxes,
        score: FloatArray,
        position_covariance: FloatArray | None = None,
        velocity_covariance: FloatArray | None = None,
    ) -> Self:
        """Rows of tracks of which no more is known."""
        n = len(scene)
        unknown, whole = np.full((n, 2, 2), np.nan), np.full(n, np.nan)
        P = unknown if position_covariance is None else position_covariance
        V = unknown if velocity_covariance is None else velocity_covariance
        return cls(
            scene=scene,
            timestamp=timestamp,
            id=id_,
            boxes=boxes,
            score=score,
            position_covariance=P,
            velocity_covariance=V,
            coasting=whole,
            yaw_variance=whole,
            source=np.full(n, "observed"),
            quality=np.full(n, "low"),
            probability=np.full((n, 4), np.nan),
        )


def read_tracks(
    path: str | Path, how: TableImport | None = None, lenient: bool = False, labels: bool = False
) -> TrackRows:
    """Read a table of tracks in any of the formats of detections. Raises `InputError` naming file, row and column.

    how      what it takes to understand it, without effect on a table that saga-fg wrote
    lenient  columns that `how` names need not be there
    labels   whether the columns of labels have a meaning
    """
    columns = LABEL_COLUMNS if labels else TRACK_COLUMNS
    layout = Layout((*columns, SETTLED, *QUATERNION), TRACK_REQUIRED, lenient)
    return track_rows(read_raw_table(Path(path), layout, how, own=OWN))


def log_findings(findings: Sequence[Finding], raw: RawTable) -> None:
    """Log what is doubtful in a file; raises `InputError` for what contradicts how it is read."""
    with error_context(str(raw.path)):
        refuse_contradictions(findings, option_text({"as_given": True}, raw.within))
    for finding in findings:
        log.warning("%s: %s", raw.path, finding)


def track_rows(raw: RawTable, tell: Callable[[Sequence[Finding], RawTable], None] = log_findings) -> TrackRows:
    """The tracks in a table that may have further columns; without those of classes that are to be left out.

    tell  says what is doubtful in it, and raises `InputError` for contradictions
    """
    raw.check_numbers(NUMBERS)
    _, left_out = raw.labels()
    kept = np.flatnonzero(~left_out)
    found = box_columns(raw, left_out)
    timestamp = raw.numbers("timestamp")
    refuse(np.isnan(timestamp), lambda row: raw.fault(row, f"{raw.title('timestamp')}: expected a number, got none"))
    scene = raw.texts("scene", raw.path.stem)[kept]
    if not raw.how.as_given and len(kept):
        first = scene == scene[0]
        mine = kept[first]
        in_world = (raw.texts("coordinates", raw.how.coordinates or "world") == "world")[mine]
        yaw = raw.numbers("yaw")[mine]
        sample = Sample.from_rows(timestamp[mine], found.boxes.select(mine), found.score[mine], yaw, in_world)
        tell(raw.how.judged([*raw.findings(), *findings_of(sample)], raw.found.names, raw.within), raw)
    return TrackRows(
        scene=scene,
        timestamp=timestamp[kept],
        id=raw.identities("id")[kept],
        boxes=found.boxes.select(kept),
        score=found.score[kept],
        position_covariance=_covariance(raw, POSITION_COVARIANCE)[kept],
        velocity_covariance=_covariance(raw, VELOCITY_COVARIANCE)[kept],
        coasting=raw.numbers("coasting")[kept],
        yaw_variance=raw.numbers("yaw_variance")[kept],
        source=raw.texts("source", "observed")[kept],
        quality=raw.texts("quality", "low")[kept],
        probability=np.column_stack([raw.numbers(name) for name in PROBABILITIES])[kept],
        named="scene" in raw.columns,
    )


def _covariance(raw: RawTable, names: tuple[str, str, str]) -> FloatArray:
    return from_upper_triangle(np.stack([raw.numbers(name) for name in names], axis=-1))


def prediction_columns(predicted: PredictedTracks) -> dict[str, Any]:
    """Columns of a table: the mean of each track at each horizon, `mode` "", then the modes of hidden tracks."""
    mean, modes = predicted.table_columns(), predicted.table_columns(modes=True, hidden=True)
    mean |= {"probability": np.ones(len(mean["id"])), "mode": np.full(len(mean["id"]), "")}
    return {name: np.concatenate([column, modes[name]]) for name, column in mean.items()}


PREDICTION_COLUMNS = ("scene", *prediction_columns(PredictedTracks.empty(0.0, np.zeros(1))))
SUFFIX = ".predictions.csv"


@dataclass(frozen=True, eq=False)
class PredictionRows(Columns):
    """R predicted positions.

    timestamp (R,) of the moment, s; horizon (R,), s; id (R,); position (R, 2), m; covariance (R, 2, 2), m^2
    mode (R,) "" for the mean of a track, else the name of one of its modes, and probability (R,) of this
    """

    timestamp: FloatArray
    horizon: FloatArray
    id: StrArray
    position: FloatArray
    covariance: FloatArray
    mode: StrArray
    probability: FloatArray

    @classmethod
    def from_moments(cls, moments: Sequence[PredictedTracks]) -> Self:
        """The rows of what was predicted at several moments."""
        tables = [prediction_columns(each) for each in (PredictedTracks.empty(0.0, np.zeros(1)), *moments)]
        columns = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
        return cls(
            columns["timestamp"],
            columns["horizon"],
            columns["id"].astype(np.str_),
            np.stack([columns["x"], columns["y"]], axis=-1),
            from_upper_triangle(np.stack([columns[name] for name in POSITION_COVARIANCE], axis=-1)),
            columns["mode"],
            columns["probability"],
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
        yield lambda scene, moments: writer.writerows(row for each in moments for row in _prediction_rows(scene, each))
        file.detach()


def _prediction_rows(scene: str, predicted: PredictedTracks) -> Iterator[list[Any]]:
    columns = prediction_columns(predicted)
    exact = [columns.pop(name).tolist() for name in ("timestamp", "horizon", "id", "label", "mode")]
    numbers = np.column_stack(list(columns.values())).tolist()
    for *names, mode, row in zip(*exact, numbers, strict=True):
        yield [scene, *names, *(None if x != x else round(x, 4) for x in row), mode]


def predictions_path(result: Path) -> Path:
    """The table of predictions beside a result, a file or a folder."""
    return result.with_name(f"{result.name}{SUFFIX}")


_LARGEST_ID = 2**53  # beyond, numbers are not exact


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
    columns = {name: raw.numbers(name) for name in numbers}
    for name in numbers:
        if np.isnan(columns[name]).any():
            raise raw.fault(int(np.argmax(np.isnan(columns[name]))), f"{name}: expected a number, got none")
    odd = (columns["id"] != np.rint(columns["id"])) | (np.abs(columns["id"]) > _LARGEST_ID)
    expected = f"id: expected a whole number within {_LARGEST_ID}"
    refuse(odd, lambda row: raw.fault(row, f"{expected}, got {columns['id'][row]:g}"))
    rows = PredictionRows(
        columns["timestamp"],
        columns["horizon"],
        columns["id"].astype(np.int64).astype(np.str_),
        np.stack([columns["x"], columns["y"]], axis=-1),
        _covariance(raw, POSITION_COVARIANCE),
        raw.texts("mode", ""),
        np.nan_to_num(raw.numbers("probability"), nan=1.0),
    )
    scene = raw.texts("scene", Path(path.name.removesuffix(SUFFIX)).stem)
    return {str(name): rows.select(np.flatnonzero(scene == name)) for name in np.unique(scene)}

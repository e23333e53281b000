"""nuScenes result files, detections or tracks: read sample by sample, and written.

The boxes of a nuScenes result file, detections or tracks, as columns.

A result file is `{"meta": {...}, "results": {sample_token: [box, ...]}}`; a box has, in the global frame,

    sample_token, translation (x, y, z of the centre, m), size (width, length, height, m),
    rotation (unit quaternion w, x, y, z), velocity (vx, vy, m/s; NaN or null for unknown),

and `detection_name`, `detection_score` or `tracking_name`, `tracking_score`, `tracking_id`. A field of our own, which
the official evaluation leaves alone, is `position_covariance` (xx, xy, yy of the horizontal position, m^2) of a track.
Source: https://github.com/nutonomy/nuscenes-devkit, python-sdk/nuscenes/eval/{detection,tracking}/README.md.

Here sizes are (length, width, height) and rotations are yaw angles.

Tracking results in the official nuScenes format, written and read.

    {"meta": {"use_camera": bool, ...}, "results": {sample_token: [{sample_token, translation, size (w, l, h),
     rotation (w, x, y, z), velocity (vx, vy), tracking_id, tracking_name, tracking_score}, ...]}}

in the global frame. Every sample of a scene is listed, with at most 500 boxes; a track keeps its class. Source:
https://github.com/nutonomy/nuscenes-devkit, python-sdk/nuscenes/eval/tracking/README.md.

A box written here has one field more, which the official evaluation leaves alone: `position_covariance` (xx, xy, yy of
the horizontal position, m^2). A velocity that is unknown (`saga_fg.types.track.known_velocities`) is written as 0.
"""

from __future__ import annotations

import io
import json
from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np

from data_tools.datasets.nuscenes.tables import DETECTION_CLASSES, TRACKING_CLASSES
from data_tools.files.atomic_files import atomic_file
from data_tools.files.input_files import error_context, unknown_name
from data_tools.files.readers import JsonStream, open_json
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import BoolArray, Columns, FloatArray, StrArray, from_upper_triangle, upper_triangle
from saga_fg.numerics.geometry import quaternion_norms, quaternion_yaw, yaw_quaternion
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Scene
from saga_fg.types.track import Tracks, known_velocities

Task = Literal["detection", "tracking"]
_UNKNOWN = (np.nan, np.nan)
_NUMBERS = {"translation": 3, "size": 3, "rotation": 4, "velocity": 2, "score": 1, "position_covariance": 3}
_NO_COVARIANCE = (np.nan, np.nan, np.nan)


@dataclass(frozen=True, eq=False)
class ResultBoxes(Columns):
    """N boxes: tracks' `id` (N,) ("" for detections), `boxes` and `score` (N,).

    position_covariance (N, 2, 2), m^2: NaN where the file has none.
    """

    id: StrArray
    boxes: Boxes
    score: FloatArray
    position_covariance: FloatArray


@dataclass(frozen=True, eq=False)
class ResultFile:
    """A result file: its `meta`, its boxes, and which of them are those of each sample, by token."""

    meta: ResultMeta
    boxes: ResultBoxes
    rows: dict[str, slice]

    @property
    def samples(self) -> dict[str, ResultBoxes]:
        """The boxes of every sample by token."""
        return {token: self.boxes.select(rows) for token, rows in self.rows.items()}


class ResultColumns:
    """Collects the boxes of one file sample by sample, then checks and converts them all at once."""

    def __init__(self, path: str, task: Task) -> None:
        self._path, self._task = path, task
        self._numbers: dict[str, list[FloatArray]] = {name: [] for name in _NUMBERS}
        self._labels: list[str] = []
        self._ids: list[str] = []
        self._rows: dict[str, slice] = {}

    def add(self, token: str, boxes: Any) -> None:
        """Take in the boxes of one sample. Raises `InputError` for a box that lacks a field or has one misshaped."""
        where = f"{self._path}: sample {token}"
        if not isinstance(boxes, list):
            raise InputError(f"{where}: expected a list of boxes, got {str(boxes)[:40]!r}")
        if token in self._rows:
            raise InputError(f"{where}: expected each sample once, this one occurs again")
        label, score = f"{self._task}_name", f"{self._task}_score"
        try:
            columns: dict[str, list[Any]] = {name: [box[name] for box in boxes] for name in _NUMBERS if name in _FIXED}
            columns["velocity"] = [_velocity(box) for box in boxes]
            columns["score"] = [(box[score],) for box in boxes]
            columns["position_covariance"] = [box.get("position_covariance", _NO_COVARIANCE) for box in boxes]
            labels = [box[label] for box in boxes]
            ids = [box["tracking_id"] for box in boxes] if self._task == "tracking" else [""] * len(boxes)
            strangers = [box for box in boxes if box.get("sample_token", token) != token]
        except (KeyError, TypeError, AttributeError) as error:
            raise InputError(f"{where}: {_missing(boxes, (*_FIXED, label, score), self._task)}") from error
        if strangers:
            raise InputError(f"{where}: sample_token: expected the sample's own, got {strangers[0]['sample_token']!r}")
        for name, column in columns.items():
            self._numbers[name].append(_table(f"{where}: ", self._task, name, column))
        for name, names in ((label, labels), ("tracking_id", ids)):
            for i, value in enumerate(names):
                if not isinstance(value, str):
                    raise InputError(f"{where}: box {i}: {name}: expected a string, got {value!r}")
        self._rows[token] = slice(len(self._labels), len(self._labels) + len(boxes))
        self._labels += labels
        self._ids += ids

    def finish(self) -> tuple[ResultBoxes, dict[str, slice]]:
        """Check the values; return the boxes and the rows of each sample.

        Raises `InputError` naming sample, box and field.
        """
        columns = {name: np.concatenate([np.empty((0, n)), *self._numbers[name]]) for name, n in _NUMBERS.items()}
        norm = quaternion_norms(columns["rotation"])
        for name, good, expected in (
            ("translation", np.isfinite(columns["translation"]).all(axis=1), "three finite numbers in m"),
            (
                "size",
                (np.isfinite(columns["size"]) & (columns["size"] > 0)).all(axis=1),
                "positive width, length, height in m",
            ),
            ("rotation", np.abs(norm - 1) <= 1e-3, "a unit quaternion (w, x, y, z)"),
            ("velocity", ~np.isinf(columns["velocity"]).any(axis=1), "finite numbers, or NaN for unknown"),
            ("score", np.isfinite(columns["score"]).all(axis=1), "a finite number"),
            (
                "position_covariance",
                ~np.isinf(columns["position_covariance"]).any(axis=1),
                "finite numbers (xx, xy, yy) in m^2",
            ),
        ):
            self._require(good, name, columns[name], expected)
        labels = np.array(self._labels, dtype=np.str_)
        known = DETECTION_CLASSES if self._task == "detection" else TRACKING_CLASSES
        strange = ~np.isin(labels, known)
        if strange.any():
            row = int(np.argmax(strange))
            raise InputError(f"{self._where(row)}: {self._task}_name: {unknown_name('class', str(labels[row]), known)}")
        boxes = Boxes(
            label=labels,
            position=columns["translation"],
            size=columns["size"][:, [1, 0, 2]],
            yaw=quaternion_yaw(columns["rotation"] / norm[:, None]),
            velocity=columns["velocity"],
        )
        covariance = from_upper_triangle(columns["position_covariance"])
        ids = np.array(self._ids, dtype=np.str_)
        return ResultBoxes(ids, boxes, columns["score"][:, 0], covariance), self._rows

    def _require(self, good: BoolArray, name: str, column: FloatArray, expected: str) -> None:
        if not good.all():
            row = int(np.argmin(good))
            field = f"{self._task}_score" if name == "score" else name
            value = column[row].tolist() if column.shape[1] > 1 else float(column[row, 0])
            raise InputError(f"{self._where(row)}: {field}: expected {expected}, got {value}")

    def _where(self, row: int) -> str:
        token, rows = next((t, r) for t, r in self._rows.items() if r.start <= row < r.stop)
        return f"{self._path}: sample {token}: box {row - rows.start}"


_FIXED = ("translation", "size", "rotation")


def _velocity(box: dict[str, Any]) -> Any:
    velocity = box.get("velocity")
    return _UNKNOWN if velocity is None else velocity


def _table(where: str, task: Task, name: str, column: Sequence[Any]) -> FloatArray:
    """Rows of numbers as an array of the field's width."""
    width = _NUMBERS[name]
    try:
        table = np.array(column)
        if table.dtype.kind in "fiu" and table.shape == (len(column), width):
            return np.asarray(table, dtype=np.float64)
    except ValueError:  # rows of different lengths
        pass
    if not column:
        return np.empty((0, width))
    for i, row in enumerate(column):
        numbers = isinstance(row, list | tuple) and all(type(x) in (int, float) for x in row)
        if not numbers or len(row) != width:
            field = f"{task}_score" if name == "score" else name
            numerals = "a number" if width == 1 else f"{width} numbers"
            got = row[0] if name == "score" else row
            raise InputError(f"{where}box {i}: {field}: expected {numerals}, got {str(got)[:60]!r}")
    raise InputError(f"{where}{name}: expected numbers of ordinary magnitude")


def _missing(boxes: list[Any], fields: tuple[str, ...], task: Task) -> str:
    if task == "tracking":
        fields = (*fields, "tracking_id")
    for i, box in enumerate(boxes):
        if not isinstance(box, dict):
            return f"box {i}: expected an object, got {str(box)[:40]}"
        for field in fields:
            if field not in box:
                return f"box {i}: field {field!r} is missing"
    return "expected a list of boxes"


@dataclass(frozen=True)
class ResultMeta:
    """Sensors and data that a result uses: the official `meta` of a result file."""

    use_camera: bool = False
    use_lidar: bool = False
    use_radar: bool = False
    use_map: bool = False
    use_external: bool = False

    @classmethod
    def union(cls, *metas: ResultMeta) -> Self:
        """Everything that several results use together."""
        return cls(**{f.name: any(getattr(meta, f.name) for meta in metas) for f in fields(cls)})


def read_result_file(
    path: str | Path, task: Task, known: Container[str] | None = None, wanted: Container[str] | None = None
) -> ResultFile:
    """Read the boxes of the `wanted` samples (None: of all).

    Raises `InputError` for a file that cannot be read or is not JSON, for samples that are not among the `known` ones
    (None: any will do), and for boxes of wanted samples that are not as the format says.
    """
    path = Path(path)
    columns = ResultColumns(str(path), task)
    meta = ResultMeta()
    for token, value in result_entries(path):
        if token is None:
            meta = _meta(path, value)
        elif known is not None and token not in known:
            raise InputError(f"{path}: sample {token}: expected samples of the tables, they hold no such sample")
        elif wanted is None or token in wanted:
            columns.add(token, value)
    return ResultFile(meta, *columns.finish())


def result_entries(path: Path) -> Iterator[tuple[str | None, Any]]:
    """Each sample's token and its boxes as they stand in the file; None and the file's `meta` in between.

    Raises `InputError` for a file that cannot be read, is not JSON or has no results.
    """
    found = False
    with open_json(path) as file:
        stream = JsonStream(file, str(path))
        for key in stream.members():
            if key == "results":
                found = True
                for token in stream.members():
                    yield token, stream.value()
            else:
                value = stream.value()
                if key == "meta":
                    yield None, value
        stream.end()
    if not found:
        raise InputError(f"{path}: expected a field 'results' with the boxes of each sample")


def _meta(path: Path, value: Any) -> ResultMeta:
    if not isinstance(value, dict):
        raise InputError(f"{path}: meta: expected an object with use_camera, use_lidar, ..., got {str(value)[:40]}")
    return ResultMeta(**{f.name: bool(value.get(f.name, False)) for f in fields(ResultMeta)})


MAX_BOXES = 500  # per sample, official


def write_tracking_results(
    path: str | Path, scenes: Iterable[tuple[Scene, Sequence[Tracks]]], meta: ResultMeta
) -> None:
    """Write the tracks of some scenes, each with one `Tracks` for each of its timestamps, in order.

    `scenes` may be a generator: it is consumed while the file is written, and the file appears when all is done.
    Only the seven tracking classes are written, per sample the 500 boxes of highest score; an unknown velocity becomes
    zero. Track ids become "scene-id" and so are unique over scenes; of a track that changes its class, what is not of
    the first class is "scene-id-class". Raises `InputError` for a path that is not writable, tracks that do not fit the
    scene, a size or heading that is unknown.
    """
    _write(path, (sample for scene, moments in scenes for sample in _samples(str(path), scene, moments)), meta)


def merge_tracking_results(path: str | Path, parts: Iterable[Path], meta: ResultMeta) -> None:
    """Write the samples of several result files into one, in order; never more than one sample is in memory.

    Raises `InputError` as `write_tracking_results` does, and for parts that are no result files.
    """
    _write(path, ((token, boxes) for part in parts for token, boxes in result_entries(part) if token is not None), meta)


def _write(path: str | Path, samples: Iterable[tuple[str, list[dict[str, Any]]]], meta: ResultMeta) -> None:
    with atomic_file(path) as binary:
        file = io.TextIOWrapper(binary, encoding="utf-8", write_through=True)
        file.write(f'{{"meta": {json.dumps(asdict(meta))}, "results": {{')
        written: set[str] = set()
        for token, boxes in samples:
            if not token or token in written:
                raise InputError(f"{path}: expected a token of its own for every sample, got {token!r}")
            file.write(f"{',' if written else ''}\n{json.dumps(token)}: {json.dumps(boxes, allow_nan=False)}")
            written.add(token)
        file.write("\n}}\n")
        file.detach()


def _samples(path: str, scene: Scene, moments: Sequence[Tracks]) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Token and boxes of each sample of a scene."""
    with error_context(f"{path}: scene {scene.name}"):
        if len(moments) != len(scene):
            raise InputError(f"expected tracks for {len(scene)} samples, got {len(moments)}")
        class_of: dict[int, str] = {}
        for token, tracks in zip(scene.tokens, moments, strict=True):
            yield token, _boxes(scene.name, token, tracks, class_of)


def _boxes(scene: str, token: str, tracks: Tracks, class_of: dict[int, str]) -> list[dict[str, Any]]:
    rows = np.flatnonzero(np.isin(tracks.boxes.label, TRACKING_CLASSES))
    best = np.argsort(-tracks.score[rows], kind="stable")[:MAX_BOXES]
    chosen = tracks.select(rows[np.sort(best)])
    boxes = chosen.boxes
    names = []
    for id_, label in zip(chosen.id.tolist(), boxes.label.tolist(), strict=True):
        first = class_of.setdefault(id_, label) == label
        names.append(f"{scene}-{id_}" if first else f"{scene}-{id_}-{label}")
    unmeasured = ~np.isfinite(boxes.size).all(axis=1) | ~np.isfinite(boxes.yaw)
    if unmeasured.any():
        id_ = int(chosen.id[np.argmax(unmeasured)])
        raise InputError(f"sample {token}: track {id_}: expected a known size and heading, the format requires them")
    columns = zip(
        boxes.position.round(6).tolist(),
        boxes.size[:, [1, 0, 2]].round(6).tolist(),
        yaw_quaternion(boxes.yaw).round(12).tolist(),
        np.nan_to_num(known_velocities(boxes.velocity, chosen.velocity_covariance)).round(6).tolist(),
        names,
        boxes.label.tolist(),
        chosen.score.tolist(),
        upper_triangle(chosen.position_covariance).round(6).tolist(),
        strict=True,
    )
    return [
        {
            "sample_token": token,
            "translation": translation,
            "size": size,
            "rotation": rotation,
            "velocity": velocity,
            "tracking_id": name,
            "tracking_name": label,
            "tracking_score": score,
            "position_covariance": covariance,
        }
        for translation, size, rotation, velocity, name, label, score, covariance in columns
    ]


def read_tracking_results(path: str | Path) -> ResultFile:
    """Read a tracking result file. Raises `InputError` naming sample, box and field of what is not as it should be."""
    result = read_result_file(path, "tracking")
    for token, rows in result.rows.items():
        ids = result.boxes.id[rows]
        if len(np.unique(ids)) != len(ids):
            raise InputError(f"{path}: sample {token}: tracking_id: expected each track at most once")
    return result

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
from data_tools.datasets.source import require_measured
from data_tools.files import JsonStream, atomic_file, open_json
from saga_fg.errors import InputError, error_context, unknown_name
from saga_fg.numerics import (
    Columns,
    FloatArray,
    StrArray,
    from_upper_triangle,
    quaternion_norms,
    quaternion_yaw,
    upper_triangle,
    yaw_quaternion,
)
from saga_fg.types import Boxes, Scene, Tracks, known_velocities

Task = Literal["detection", "tracking"]
_UNKNOWN = (np.nan, np.nan)
_WIDTHS = {"translation": 3, "size": 3, "rotation": 4, "velocity": 2, "position_covariance": 3}
_FIXED = ("translation", "size", "rotation")
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


def _sample_boxes(where: str, task: Task, token: str, boxes: Any) -> ResultBoxes:
    """The boxes of one sample. Raises `InputError` naming box and field of what is not as the format says."""
    if not isinstance(boxes, list):
        raise InputError(f"{where}: expected a list of boxes, got {str(boxes)[:40]!r}")
    label, score = f"{task}_name", f"{task}_score"
    try:
        columns: dict[str, list[Any]] = {name: [box[name] for box in boxes] for name in _FIXED}
        columns["velocity"] = [_UNKNOWN if box.get("velocity") is None else box["velocity"] for box in boxes]
        columns[score] = [(box[score],) for box in boxes]
        columns["position_covariance"] = [box.get("position_covariance", _NO_COVARIANCE) for box in boxes]
        labels = [box[label] for box in boxes]
        ids = [box["tracking_id"] for box in boxes] if task == "tracking" else [""] * len(boxes)
        strangers = [box for box in boxes if box.get("sample_token", token) != token]
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{where}: {_missing(boxes, (*_FIXED, label, score), task)}") from error
    if strangers:
        raise InputError(f"{where}: sample_token: expected the sample's own, got {strangers[0]['sample_token']!r}")
    for name, names in ((label, labels), ("tracking_id", ids)):
        for row, value in enumerate(names):
            if not isinstance(value, str):
                raise InputError(f"{where}: box {row}: {name}: expected a string, got {value!r}")
    numbers = {name: _table(where, name, column, _WIDTHS.get(name, 1)) for name, column in columns.items()}
    norm = quaternion_norms(numbers["rotation"])
    finite = {name: np.isfinite(column).all(axis=1) for name, column in numbers.items()}
    for name, good, expected in (
        ("translation", finite["translation"], "three finite numbers in m"),
        ("size", finite["size"] & (numbers["size"] > 0).all(axis=1), "positive width, length, height in m"),
        ("rotation", np.abs(norm - 1) <= 1e-3, "a unit quaternion (w, x, y, z)"),
        ("velocity", ~np.isinf(numbers["velocity"]).any(axis=1), "finite numbers, or NaN for unknown"),
        (score, finite[score], "a finite number"),
        (
            "position_covariance",
            ~np.isinf(numbers["position_covariance"]).any(axis=1),
            "finite numbers (xx, xy, yy) in m^2",
        ),
    ):
        if not good.all():
            row = int(np.argmin(good))
            value = numbers[name][row].tolist()
            got = value if len(value) > 1 else value[0]
            raise InputError(f"{where}: box {row}: {name}: expected {expected}, got {got}")
    classes = DETECTION_CLASSES if task == "detection" else TRACKING_CLASSES
    for row, name in enumerate(labels):
        if name not in classes:
            raise InputError(f"{where}: box {row}: {label}: {unknown_name('class', name, classes)}")
    read = Boxes(
        label=np.array(labels, dtype=np.str_),
        position=numbers["translation"],
        size=numbers["size"][:, [1, 0, 2]],
        yaw=quaternion_yaw(numbers["rotation"] / norm[:, None]),
        velocity=numbers["velocity"],
    )
    covariance = from_upper_triangle(numbers["position_covariance"])
    return ResultBoxes(np.array(ids, dtype=np.str_), read, numbers[score][:, 0], covariance)


def _table(where: str, name: str, column: Sequence[Any], width: int) -> FloatArray:
    """Rows of numbers as an array of the field's width."""
    try:
        table = np.array(column)
        if table.dtype.kind in "fiu" and table.shape == (len(column), width):
            return np.asarray(table, dtype=np.float64)
    except ValueError:  # rows of different lengths
        pass
    if not column:
        return np.empty((0, width))
    for row, value in enumerate(column):
        numbers = isinstance(value, list | tuple) and all(type(x) in (int, float) for x in value)
        if not numbers or len(value) != width:
            numerals = "a number" if width == 1 else f"{width} numbers"
            got = value[0] if width == 1 else value
            raise InputError(f"{where}: box {row}: {name}: expected {numerals}, got {str(got)[:60]!r}")
    raise InputError(f"{where}: {name}: expected numbers of ordinary magnitude")


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
    path, meta = Path(path), ResultMeta()
    parts = [_sample_boxes(str(path), task, "", [])]
    rows: dict[str, slice] = {}
    last = 0
    for token, value in result_entries(path):
        if token is None:
            meta = _meta(path, value)
        elif known is not None and token not in known:
            raise InputError(f"{path}: sample {token}: expected samples of the tables, they hold no such sample")
        elif wanted is None or token in wanted:
            if token in rows:
                raise InputError(f"{path}: sample {token}: expected each sample once, this one occurs again")
            parts.append(_sample_boxes(f"{path}: sample {token}", task, token, value))
            rows[token] = slice(last, last + len(parts[-1]))
            last = rows[token].stop
    return ResultFile(meta, ResultBoxes.concatenate(parts), rows)


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
    require_measured(chosen, f"sample {token}")
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

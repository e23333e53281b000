"""The boxes of a nuScenes result file, detections or tracks, as columns.

A result file is `{"meta": {...}, "results": {sample_token: [box, ...]}}`; a box has, in the global frame,

    sample_token, translation (x, y, z of the centre, m), size (width, length, height, m),
    rotation (unit quaternion w, x, y, z), velocity (vx, vy, m/s; NaN or null for unknown),

and `detection_name`, `detection_score` or `tracking_name`, `tracking_score`, `tracking_id`. A field of our own, which
the official evaluation leaves alone, is `position_covariance` (xx, xy, yy of the horizontal position, m^2) of a track.
Source: https://github.com/nutonomy/nuscenes-devkit, python-sdk/nuscenes/eval/{detection,tracking}/README.md.

Here sizes are (length, width, height) and rotations are yaw angles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from data_tools.datasets.nuscenes.classes import DETECTION_CLASSES, TRACKING_CLASSES
from data_tools.files.error_messages import unknown_name
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import BoolArray, FloatArray, StrArray, from_upper_triangle
from saga_fg.numerics.geometry import quaternion_norms, quaternion_yaw
from saga_fg.types.boxes import Boxes

Task = Literal["detection", "tracking"]
_UNKNOWN = (np.nan, np.nan)
_NUMBERS = {"translation": 3, "size": 3, "rotation": 4, "velocity": 2, "score": 1, "position_covariance": 3}
_NO_COVARIANCE = (np.nan, np.nan, np.nan)


@dataclass(frozen=True, eq=False)
class ResultBoxes:
    """All boxes of a file: `boxes` and `score` (N,), tracks' `id` (N,) ("" for detections), rows of each sample.

    position_covariance (N, 2, 2), m^2: NaN where the file has none.
    """

    boxes: Boxes
    score: FloatArray
    id: StrArray
    position_covariance: FloatArray
    rows: dict[str, slice]


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

    def finish(self) -> ResultBoxes:
        """Check the values and convert. Raises `InputError` naming sample, box and field."""
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
        return ResultBoxes(boxes, columns["score"][:, 0], np.array(self._ids, dtype=np.str_), covariance, self._rows)

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

"""A first look at a table: how its columns, times and classes are understood, and what is doubtful."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from data_tools.datasets.detection_files.column_names import TableImport
from data_tools.datasets.detection_files.columns import BOX, COLUMNS, POSE, QUATERNION, REQUIRED, ROTATIONS, RawTable
from data_tools.datasets.detection_files.dataset import DetectionFile
from data_tools.datasets.detection_files.formats import ROWS, Layout, read_raw_table, sorted_by_time
from data_tools.datasets.detection_files.tracks import SETTLED, TRACK_COLUMNS
from data_tools.plausibility import Doubt, Sample, doubts_of
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import BoolArray, FloatArray

_ALL = Layout(tuple(dict.fromkeys((*COLUMNS, *TRACK_COLUMNS, SETTLED, "visible"))), REQUIRED, faulty=True)
SHOWN = (*REQUIRED, *BOX, *POSE)
GAP = 3.0  # usual steps, from which a pause counts


@dataclass(frozen=True)
class SensorTimes:
    """Frames of one sensor in one scene: how many, from when to when (s), their usual step, and the longest pause."""

    scene: str
    sensor: str
    frames: int
    first: float
    last: float
    step: float
    longest: float
    pauses: int


@dataclass(frozen=True, eq=False)
class TableSurvey:
    """The content of a table.

    raw       its columns; how: what it takes to read it; sorted: its rows are in order, or `how` sorts them
    ranges    least, median and largest number of each column, in our units
    classes   rows of each class, by the name in the file
    sizes     median length, width and height of each class, m
    times     of each sensor in each scene
    doubts    about the table as it is read now
    faults    why it cannot be read as it is, a text each
    """

    raw: RawTable
    how: TableImport
    sorted: bool
    ranges: Mapping[str, tuple[float, float, float]]
    classes: Mapping[str, int]
    sizes: Mapping[str, FloatArray]
    times: tuple[SensorTimes, ...]
    doubts: tuple[Doubt, ...]
    faults: tuple[str, ...] = ()

    @property
    def has_identities(self) -> bool:
        """True if objects have identities: these are tracks, or true objects."""
        return "id" in self.raw.columns


def survey_table(path: Path, how: TableImport | None = None) -> TableSurvey:
    """Look at a table of detections, tracks or true objects. Raises `InputError` for one that cannot be read at all."""
    how = how or TableImport()
    raw, faults = _without_faults(read_raw_table(path, _ALL, replace(how, sort=False)))
    scene, time = raw.texts("scene", raw.path.stem), raw.numbers("timestamp")
    _, of_scene = np.unique(scene, return_inverse=True)
    backwards = np.diff(time[np.argsort(of_scene, kind="stable")]) < 0
    backwards &= np.diff(np.sort(of_scene)) == 0
    scattered = raw.length > ROWS and np.count_nonzero(np.diff(of_scene)) > of_scene.max()
    in_order = not backwards.any() and not scattered  # longer tables are read in parts, a scene after the other
    ordered = raw if in_order else sorted_by_time(raw)
    doubts = raw.doubts()
    if not faults:
        try:
            table = DetectionFile(replace(ordered, columns={k: v for k, v in ordered.columns.items() if k in COLUMNS}))
            for number, name in enumerate(table.scenes):
                frames = table.scene(name).frames
                doubts += doubts_of(Sample.of(frames)) if number < 3 else []
        except InputError as error:
            faults.append(str(error).removeprefix(f"{path}: "))
    known = {doubt.kind: doubt for doubt in reversed(doubts)}
    labels = raw.texts("label", "object")
    detected = raw.present("x") if "x" in raw.columns else np.ones(raw.length, dtype=np.bool_)
    return TableSurvey(
        raw,
        replace(how, sort=how.sort or not in_order),
        in_order or how.sort,
        {name: _range(raw.numbers(name)) for name in SHOWN if name in raw.columns or _rotated(raw, name)},
        {name: int((detected & (labels == name)).sum()) for name in np.unique(labels[detected]).tolist()},
        _sizes(raw, labels, detected),
        _times(ordered) if "timestamp" in raw.columns else (),
        tuple(known.values()),
        tuple(faults),
    )


def _without_faults(raw: RawTable) -> tuple[RawTable, list[str]]:
    """The table without the columns that hold anything but finite numbers, and what is wrong with it."""
    numbers = raw.faults_of_numbers((*SHOWN, *QUATERNION))
    broken = {name for names in numbers for each in names for name in (each, *ROTATIONS.get(each, ()))}
    columns = {name: values for name, values in raw.columns.items() if name not in broken}
    return replace(raw, columns=columns), [*raw.found.faults, *numbers.values()]


def _rotated(raw: RawTable, name: str) -> bool:
    return name in ROTATIONS and QUATERNION[0] in raw.columns


def _range(numbers: FloatArray) -> tuple[float, float, float]:
    known = numbers[np.isfinite(numbers)]
    return (float(known.min()), float(np.median(known)), float(known.max())) if len(known) else (np.nan,) * 3


def _sizes(raw: RawTable, labels: np.ndarray, detected: BoolArray) -> dict[str, FloatArray]:
    size = np.stack([raw.numbers(name) for name in ("length", "width", "height")], axis=-1)
    medians = {}
    for name in np.unique(labels[detected]).tolist():
        mine = size[detected & (labels == name)]
        known = [column[np.isfinite(column)] for column in mine.T]
        medians[name] = np.array([np.median(column) if len(column) else np.nan for column in known])
    return medians


def _times(raw: RawTable) -> tuple[SensorTimes, ...]:
    scene, sensor, time = raw.texts("scene", raw.path.stem), raw.texts("sensor", "sensor"), raw.numbers("timestamp")
    found = []
    for name in dict.fromkeys(scene.tolist()):
        for each in np.unique(sensor[scene == name]).tolist():
            moments = np.unique(time[(scene == name) & (sensor == each)])
            steps = np.diff(moments)
            usual = float(np.median(steps)) if len(steps) else np.nan
            pauses = int((steps > GAP * usual).sum()) if len(steps) else 0
            longest = float(steps.max()) if len(steps) else np.nan
            found.append(
                SensorTimes(name, each, len(moments), float(moments[0]), float(moments[-1]), usual, longest, pauses)
            )
    return tuple(found)

"""A table of detections as a dataset: rows with the same scene, time and sensor become frames.

A first look at a table: how its columns, times and classes are understood, and what is doubtful.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from data_tools.datasets.detection_files.formats import ROWS, Layout, read_raw_parts, read_raw_table
from saga_fg.errors import InputError, unknown_name
from saga_fg.numerics import BoolArray, FloatArray
from saga_fg.tables import (
    BOX,
    COLUMNS,
    POSE,
    QUATERNION,
    REQUIRED,
    ROTATIONS,
    SETTLED,
    TRACK_COLUMNS,
    DetectionTable,
    RawTable,
    TableImport,
    seems_dense_traffic,
    sorted_by_time,
)
from saga_fg.types import Finding, Scene


def read_detections(path: str | Path, how: TableImport | None = None) -> DetectionTable:
    """Read a table of detections: .csv, .ndjson, .jsonl, .npz, .parquet, .feather or .arrow.

    how  what it takes to understand it; what is left out is found by the names of the columns

    Raises `InputError` naming file, row and column.
    """
    return DetectionTable(read_raw_table(Path(path), how=how))


def read_scenes_in_parts(
    path: str | Path, rows: int = ROWS, scenes: Collection[str] | None = None, how: TableImport | None = None
) -> Iterator[Scene]:
    """The scenes of a table as they come, each as successive `Scene`s of about `rows` rows: without holding them all.

    scenes: the names of those wanted, None for all

    Raises `InputError` as `read_detections` does, when it comes to the row; where a scene goes on after another; and at
    the end, for names that did not come.
    """
    done: set[str] = set()
    name, latest, with_poses = "", -np.inf, None
    for table in read_raw_parts(Path(path), how=how, rows=rows):
        part = DetectionTable(table, judged=with_poses is None)
        if with_poses not in (None, part.with_poses):
            raise InputError(f"{path}: {table.where(0)}: ego_x, ego_y, ego_yaw: expected in all rows or in none")
        with_poses = part.with_poses
        for scene in (part.scene(name) for name in part.scenes):
            if scene.name in done:
                raise InputError(f"{path}: scene {scene.name}: expected its rows together, it goes on after {name}")
            if scene.name != name:
                done.add(name)
                name, latest = scene.name, -np.inf
            if scene.timestamps[0] <= latest:
                raise InputError(
                    f"{path}: {table.where(0)}: timestamp: expected rows in order of time, "
                    f"time runs backwards at {scene.timestamps[0]} s"
                )
            latest = float(scene.timestamps[-1])
            if scenes is None or name in scenes:
                yield scene
    for wanted in scenes or ():
        if wanted not in done and wanted != name:
            raise InputError(f"{path}: {unknown_name('scene', wanted, tuple(sorted({*done, name} - {''})))}")


def dense_traffic_of(path: Path, how: TableImport) -> str:
    """Why the first rows of a table look like dense road traffic, "" if they do not."""
    first = next(read_scenes_in_parts(path, how=how), None)
    return "" if first is None else seems_dense_traffic(first.frames)


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
    findings    about the table as it is read now
    faults    why it cannot be read as it is, a text each
    dense_traffic  why it looks like dense road traffic, "" if it does not
    """

    raw: RawTable
    how: TableImport
    sorted: bool
    ranges: Mapping[str, tuple[float, float, float]]
    classes: Mapping[str, int]
    sizes: Mapping[str, FloatArray]
    times: tuple[SensorTimes, ...]
    findings: tuple[Finding, ...]
    faults: tuple[str, ...] = ()
    dense_traffic: str = ""

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
    findings, dense = [] if not faults else raw.findings(), ""
    if not faults:
        try:
            table = DetectionTable(replace(ordered, columns={k: v for k, v in ordered.columns.items() if k in COLUMNS}))
            for name in table.scenes:
                findings += table.scene(name).findings or ()
            dense = dense_traffic_of(path, replace(how, sort=how.sort or not in_order))
        except InputError as error:
            faults.append(str(error).removeprefix(f"{path}: "))
    known = {finding.kind: finding for finding in reversed(findings)}
    labels = raw.texts("label", "object")
    detected = raw.present("x") if "x" in raw.columns else np.ones(raw.length, dtype=np.bool_)
    return TableSurvey(
        raw=raw,
        how=replace(how, sort=how.sort or not in_order),
        sorted=in_order or how.sort,
        ranges={name: _range(raw.numbers(name)) for name in SHOWN if name in raw.columns or _rotated(raw, name)},
        classes={name: int((detected & (labels == name)).sum()) for name in np.unique(labels[detected]).tolist()},
        sizes=_sizes(raw, labels, detected),
        times=_times(ordered) if "timestamp" in raw.columns else (),
        findings=tuple(known.values()),
        faults=tuple(faults),
        dense_traffic=dense,
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
                SensorTimes(
                    scene=name,
                    sensor=each,
                    frames=len(moments),
                    first=float(moments[0]),
                    last=float(moments[-1]),
                    step=usual,
                    longest=longest,
                    pauses=pauses,
                )
            )
    return tuple(found)

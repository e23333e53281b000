"""A table of detections as a dataset: rows with the same scene, time and sensor become frames.

A first look at a table: how its columns, times and classes are understood, and what is doubtful.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np

from data_tools.datasets.detection_files.column_names import TableImport
from data_tools.datasets.detection_files.columns import (
    BOX,
    COLUMNS,
    GPS,
    ODOMETRY,
    POSE,
    QUATERNION,
    REQUIRED,
    ROTATIONS,
    SETTLED,
    TRACK_COLUMNS,
    EgoColumns,
    RawTable,
)
from data_tools.datasets.detection_files.formats import ROWS, Layout, read_raw_parts, read_raw_table, sorted_by_time
from data_tools.files.input_files import error_context, unknown_name
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, StrArray
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Scene
from saga_fg.types.frame import Coordinates, Detections, Frame
from saga_fg.types.plausibility import Finding, Sample, findings_of

_COORDINATES = ("world", "ego", "sensor")


@dataclass(frozen=True, eq=False)
class _Rows:
    """The checked table: N rows, of which those that are not `empty` hold a detection."""

    raw: RawTable
    scene: StrArray
    timestamp: FloatArray
    sensor: StrArray
    coordinates: StrArray
    empty: BoolArray
    detections: Detections
    pose: FloatArray | None  # (N, 4): x, y, z, yaw
    ego: EgoColumns | None


class DetectionFile:
    """The scenes of one table of detections. See the package for its columns.

    A scene's moments are all times at which some sensor spoke; without pose columns its poses are the identity.
    """

    def __init__(self, table: RawTable) -> None:
        """Check everything. Raises `InputError` naming file, row and column."""
        self._rows = _checked(table)
        names, first = np.unique(self._rows.scene, return_index=True)
        self._scenes = tuple(names[np.argsort(first)].tolist())

    @property
    def scenes(self) -> tuple[str, ...]:
        """The names of the scenes, in the order of the file."""
        return self._scenes

    def scene(self, name: str) -> Scene:
        """One of the scenes; raises `InputError` for an unknown name."""
        path = self._rows.raw.path
        if name not in self._scenes:
            raise InputError(f"{path}: {unknown_name('scene', name, self._scenes)}")
        rows = np.flatnonzero(self._rows.scene == name)
        times, moment = np.unique(self._rows.timestamp[rows], return_inverse=True)
        with error_context(f"{path}: scene {name}"):
            poses = self._poses(rows, moment, len(times))
            world_T_ego = np.tile(np.eye(4), (len(times), 1, 1)) if poses is None else poses
            return Scene(name, times, world_T_ego, ("",) * len(times), self._frames(rows, moment, poses))

    @property
    def with_poses(self) -> bool:
        """True if the table has poses of the vehicle."""
        return self._rows.pose is not None

    def _poses(self, rows: IntArray, moment: IntArray, count: int) -> FloatArray | None:
        """world_T_ego (K, 4, 4) of the moments of a scene, None without pose columns."""
        if self._rows.pose is None:
            return None
        pose = self._rows.pose[rows]
        _, first = np.unique(moment, return_index=True)
        other = (pose != pose[first][moment]).any(axis=1)
        if other.any():
            row = int(rows[np.argmax(other)])
            raise self._rows.raw.fault(row, "ego_x, ego_y, ego_z, ego_yaw: expected one pose at one time, got another")
        return np.array([yaw_transform(*pose[k]) for k in first.tolist()]).reshape(count, 4, 4)

    def _frames(self, rows: IntArray, moment: IntArray, poses: FloatArray | None) -> list[Frame]:
        table = self._rows
        sensors, sensor = np.unique(table.sensor[rows], return_inverse=True)
        key = moment * len(sensors) + sensor
        order = np.argsort(key, kind="stable")
        starts = np.flatnonzero(np.diff(key[order], prepend=-1))
        frames = []
        for group in np.split(order, starts[1:]):
            k = int(moment[group[0]])
            members = rows[group]
            kind = table.coordinates[members]
            if (kind != kind[0]).any():
                row = int(members[np.argmax(kind != kind[0])])
                raise table.raw.fault(row, "coordinates: expected the same in all rows of a frame")
            frames.append(
                Frame(
                    timestamp=float(table.timestamp[members[0]]),
                    sensor=str(table.sensor[members[0]]),
                    detections=table.detections.select(members[~table.empty[members]]),
                    world_T_ego=None if poses is None else poses[k],
                    coordinates=cast(Coordinates, str(kind[0])),
                    ego=None if table.ego is None else table.ego.measured(members),
                )
            )
        return frames


def read_detections(path: str | Path, how: TableImport | None = None) -> DetectionFile:
    """Read a table of detections: .csv, .ndjson, .jsonl, .npz, .parquet, .feather or .arrow.

    how  what it takes to understand it; what is left out is found by the names of the columns

    Raises `InputError` naming file, row and column.
    """
    raw = read_raw_table(Path(path), how=how)
    table = DetectionFile(raw)
    raw.warn_of_findings()
    return table


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
        part = DetectionFile(table)
        if with_poses is None:
            table.warn_of_findings()
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


def _checked(raw: RawTable) -> _Rows:
    if raw.length == 0:
        raise InputError(f"{raw.path}: expected at least one row, the table is empty")
    raw.check_numbers(("timestamp", "x", "y", *BOX, *POSE, *ODOMETRY, *GPS))
    timestamp = raw.numbers("timestamp")
    _require(raw, np.isfinite(timestamp), "timestamp", timestamp, "a finite number of seconds")
    scene = raw.texts("scene", raw.path.stem)
    _check_order(raw, scene, timestamp)
    empty = raw.flags("empty") | (~raw.present("x") & ~raw.present("y")) | raw.labels()[1]
    coordinates = raw.texts("coordinates", raw.how.coordinates or "world")
    strange = ~np.isin(coordinates, _COORDINATES)
    if strange.any():
        row = int(np.argmax(strange))
        raise raw.fault(row, f"coordinates: expected world, ego or sensor, got {str(coordinates[row])!r}")
    ego = EgoColumns.from_table(raw)
    pose = _pose(raw, coordinates, ego is not None)
    detections = box_columns(raw, empty)
    return _Rows(
        raw=raw,
        scene=scene,
        timestamp=timestamp,
        sensor=raw.texts("sensor", "sensor"),
        coordinates=coordinates,
        empty=empty,
        detections=detections,
        pose=pose,
        ego=ego,
    )


def _check_order(raw: RawTable, scene: StrArray, timestamp: FloatArray) -> None:
    order = np.argsort(scene, kind="stable")
    late = (np.diff(timestamp[order]) < 0) & (scene[order][1:] == scene[order][:-1])
    if late.any():
        row = int(order[1:][np.argmax(late)])
        title = raw.title("timestamp")
        text = f"{title}: expected rows in order of time, time runs backwards at {timestamp[row]} s; --sort sorts them"
        raise raw.fault(row, text)


def box_columns(raw: RawTable, empty: BoolArray) -> Detections:
    """Boxes and scores of all rows; those of empty rows hold zeros and are never looked at."""
    position = np.stack([raw.numbers("x"), raw.numbers("y"), raw.numbers("z", 0.0)], axis=-1)
    position[empty] = 0.0
    for axis, name in enumerate("xyz"):
        column = position[:, axis]
        _require(raw, np.isfinite(column), name, column, "a finite number of metres")
    size = np.stack([raw.numbers(name) for name in ("length", "width", "height")], axis=-1)
    size[empty] = np.nan
    for axis, name in enumerate(("length", "width", "height")):
        column = size[:, axis]
        _require(raw, ~(column <= 0), name, column, "a positive number of metres")
    score = np.where(empty, 0.0, raw.numbers("score", 1.0))
    _require(raw, np.isfinite(score), "score", score, "a finite number")
    velocity = np.stack([raw.numbers("vx"), raw.numbers("vy")], axis=-1)
    boxes = Boxes(raw.labels()[0], position, size, raw.numbers("yaw"), velocity)
    return Detections(boxes, score, np.where(empty, np.nan, raw.numbers("range_rate")))


def _pose(raw: RawTable, coordinates: StrArray, estimated: bool) -> FloatArray | None:
    """(N, 4); None where there are none, as there may where the vehicle's own measurements stand in for them."""
    given = [name for name in POSE if raw.present(name).any()]
    if not given:
        if (coordinates != "world").any() and not estimated:
            row = int(np.argmax(coordinates != "world"))
            raise raw.fault(row, f"coordinates: {coordinates[row]} needs the columns ego_x, ego_y and ego_yaw")
        return None
    columns = {name: raw.numbers(name, 0.0 if name == "ego_z" else np.nan) for name in POSE}
    for name, column in columns.items():
        _require(raw, np.isfinite(column), name, column, f"a finite number, since {given[0]} is given")
    return np.stack(list(columns.values()), axis=-1)


def _require(raw: RawTable, good: BoolArray, name: str, column: FloatArray, expected: str) -> None:
    if not good.all():
        row = int(np.argmin(good))
        got = f"got {column[row]:g}" if raw.present(name)[row] else "it is left out"
        raise raw.fault(row, f"{raw.title(name)}: expected {expected}, {got}")


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
    findings = raw.findings()
    if not faults:
        try:
            table = DetectionFile(replace(ordered, columns={k: v for k, v in ordered.columns.items() if k in COLUMNS}))
            for number, name in enumerate(table.scenes):
                frames = table.scene(name).frames
                findings += findings_of(Sample.from_frames(frames)) if number < 3 else []
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

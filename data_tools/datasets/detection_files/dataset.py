"""Tables of detections and of true objects as datasets: rows with the same scene, time and sensor become frames.

A first look at a table: how its columns, times and classes are understood, and what is doubtful.

Tables of true objects: a row per object and moment, with the columns of tracks and `visible`, 0 where hidden.

The moments of a scene are the times of its rows. Velocities that are not there are central differences of positions
over about half a second; positions in coordinates of the vehicle are moved to the world by its pose.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from data_tools.datasets.detection_files.formats import ROWS, Layout, read_raw_parts, read_raw_table
from data_tools.datasets.detection_files.tracks import TRACK_REQUIRED, TrackRows, log_findings, track_rows
from data_tools.trajectories import central_differences
from saga_fg.errors import InputError, error_context, unknown_name
from saga_fg.numerics import BoolArray, FloatArray, yaw_transform
from saga_fg.tables import (
    BOX,
    COLUMNS,
    COMMAND,
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
from saga_fg.types import Annotations, Boxes, Finding, Scene


def read_detections(path: str | Path, how: TableImport | None = None) -> DetectionTable:
    """Read a table of detections: .csv, .ndjson, .jsonl, .npz, .parquet, .feather or .arrow.

    how  what it takes to understand it; what is left out is found by the names of the columns

    Raises `InputError` naming file, row and column.
    """
    return DetectionTable(read_raw_table(Path(path), how=how))


def read_scenes_in_parts(
    path: str | Path,
    rows: int = ROWS,
    scenes: Collection[str] | None = None,
    how: TableImport | None = None,
    quiet: bool = False,
) -> Iterator[Scene]:
    """The scenes of a table as they come, each as successive `Scene`s of about `rows` rows: without holding them all.

    scenes: the names of those wanted, None for all; quiet: nothing is said of columns and clock

    Raises `InputError` as `read_detections` does, when it comes to the row; where a scene goes on after another; and at
    the end, for names that did not come.
    """
    done: set[str] = set()
    name, latest, with_poses = "", -np.inf, None
    for table in read_raw_parts(Path(path), how=how, rows=rows, quiet=quiet):
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
    first = next(read_scenes_in_parts(path, how=how, quiet=True), None)
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
    unread      a few values of each column that has no meaning here, as text
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
    unread: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

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
    detected = raw.present("x") if "x" in raw.columns else np.full(raw.length, bool(raw.columns))
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
        unread=_unread_values(raw),
    )


def _unread_values(raw: RawTable) -> dict[str, tuple[str, ...]]:
    """The first different values of columns that have no meaning."""
    if not raw.found.unread:
        return {}
    part = next(read_raw_parts(raw.path, Layout(raw.found.unread, ()), quiet=True))
    columns = {name: part.columns.get(name, ()) for name in raw.found.unread}
    return {name: tuple(dict.fromkeys(str(each)[:24] for each in values))[:3] for name, values in columns.items()}


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


TRUTH_COLUMNS = (*TRACK_COLUMNS, SETTLED, *QUATERNION, "coordinates", *POSE, *ROTATIONS["ego_yaw"], "visible")
REACH = 0.25  # s to either side, for a velocity
LONGEST_GAP = 2.5  # steps between rows of an object, for a velocity


class TruthTable:
    """The scenes of one table of true objects, with ground truth alone.

    path  it is from, for errors
    rows  in coordinates of the vehicle where `in_ego` (N,) is set
    visible, pose, in_ego  of the rows: masks (N,), and x, y, z, yaw (N, 4) of the vehicle, NaN where unknown

    Raises `InputError` without rows.
    """

    def __init__(
        self,
        path: Path,
        rows: TrackRows,
        visible: BoolArray | None = None,
        pose: FloatArray | None = None,
        in_ego: BoolArray | None = None,
    ) -> None:
        n = len(rows.id)
        if not n:
            raise InputError(f"{path}: expected at least one row, the table is empty")
        self.path, self.rows, self.named = path, rows, rows.named
        self._visible = np.ones(n, dtype=np.bool_) if visible is None else visible
        self._pose = np.full((n, 4), np.nan) if pose is None else pose
        self._in_ego = np.zeros(n, dtype=np.bool_) if in_ego is None else in_ego
        self.posed = bool(np.isfinite(self._pose).all())
        _, first = np.unique(rows.scene, return_index=True)
        self.scenes: tuple[str, ...] = tuple(rows.scene[np.sort(first)].tolist())

    @classmethod
    def from_table(
        cls, raw: RawTable, tell: Callable[[Sequence[Finding], RawTable], None] = log_findings
    ) -> TruthTable:
        """Check everything; tell as of `track_rows`. Raises `InputError` naming file, row and column."""
        rows, kept, pose = track_rows(raw, tell), np.flatnonzero(~raw.labels()[1]), _poses(raw)
        in_ego = raw.texts("coordinates", raw.how.coordinates or "world") == "ego"
        in_ego &= np.isfinite(pose).all(axis=1)
        return cls(raw.path, rows, _visible(raw)[kept], pose[kept], in_ego[kept])

    def scene(self, name: str) -> Scene:
        """One of the scenes; raises `InputError` for an unknown name and an object that is there twice at a time."""
        if name not in self.scenes:
            raise InputError(f"{self.path}: {unknown_name('scene', name, self.scenes)}")
        rows = np.flatnonzero(self.rows.scene == name)
        times, moment = np.unique(self.rows.timestamp[rows], return_inverse=True)
        poses = _scene_poses(self.rows, rows, moment, self._pose)
        boxes = _in_world(self.rows.boxes.select(rows), self._in_ego[rows], poses[moment])
        if np.isnan(boxes.velocity).all() and len(times) > 1:
            step = float(np.median(np.diff(times)))
            reach = max(1, round(REACH / step))
            ids = self.rows.id[rows]
            velocity = central_differences(ids, times[moment], boxes.position[:, :2], LONGEST_GAP * step, reach)
            boxes = replace(boxes, velocity=velocity)
        truth = []
        for k, at in enumerate(np.split(np.argsort(moment, kind="stable"), np.cumsum(np.bincount(moment))[:-1])):
            with error_context(f"{self.path}: scene {name}: {times[k]} s"):
                truth.append(Annotations(self.rows.id[rows][at], boxes.select(at), self._visible[rows][at]))
        return Scene(name, times, poses, ground_truth=truth)


def read_truth(path: str | Path, how: TableImport | None = None, within: str = COMMAND) -> TruthTable:
    """Read a table of true objects; within: the option that is `how`. Raises `InputError` naming file, row, column."""
    layout = Layout(TRUTH_COLUMNS, TRACK_REQUIRED, lenient=True, within=within)
    return TruthTable.from_table(read_raw_table(Path(path), layout, how))


def _scene_poses(rows: TrackRows, at: Sequence[int] | np.ndarray, moment: np.ndarray, pose: FloatArray) -> FloatArray:
    """world_T_ego (K, 4, 4): those of the table, else an upright vehicle amid all objects."""
    _, first = np.unique(moment, return_index=True)
    if np.isfinite(pose[at]).all():
        return np.array([yaw_transform(*each) for each in pose[at][first].tolist()])
    poses = np.tile(np.eye(4), (len(first), 1, 1))
    poses[:, :2, 3] = np.median(rows.boxes.position[at, :2], axis=0)
    return poses


def _in_world(boxes: Boxes, in_ego: BoolArray, world_T_ego: FloatArray) -> Boxes:
    """Boxes (N) with those in coordinates of the vehicle moved to the world; poses (N, 4, 4) of their moments."""
    if not in_ego.any():
        return boxes
    R, t = world_T_ego[:, :3, :3], world_T_ego[:, :3, 3]
    turn = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    position = np.einsum("nij,nj->ni", R, boxes.position) + t
    velocity = np.einsum("nij,nj->ni", R[:, :2, :2], boxes.velocity)
    return replace(
        boxes,
        position=np.where(in_ego[:, None], position, boxes.position),
        velocity=np.where(in_ego[:, None], velocity, boxes.velocity),
        yaw=np.where(in_ego, boxes.yaw + turn, boxes.yaw),
    )


def _poses(raw: RawTable) -> FloatArray:
    """x, y, z, yaw (N, 4) of the vehicle, NaN where the table has none."""
    return np.stack([raw.numbers(name, 0.0 if name == "ego_z" else np.nan) for name in POSE], axis=-1)


def _visible(raw: RawTable) -> BoolArray:
    """Mask (N,) of the objects that can be seen: all that no column `visible` calls 0 or false."""
    values = raw.columns.get("visible", ())
    if not len(values):
        return np.ones(raw.length, dtype=np.bool_)
    listed = values.tolist() if isinstance(values, np.ndarray) else values
    return np.array([str(value).strip().lower() not in ("0", "0.0", "false") for value in listed], dtype=np.bool_)

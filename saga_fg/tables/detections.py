"""Tables of detections as recordings; those of programs too, of pandas, Polars or Arrow."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from saga_fg.errors import InputError, error_context, require_type, unknown_name
from saga_fg.numerics import BoolArray, FloatArray, IntArray, StrArray, from_upper_triangle, refuse, yaw_transform
from saga_fg.tables.column_names import TableImport, option_text, understood
from saga_fg.tables.columns import (
    BOX,
    COLUMNS,
    COVARIANCE,
    GPS,
    NAMED,
    ODOMETRY,
    POSE,
    REQUIRED,
    EgoColumns,
    RawTable,
    Values,
    as_names,
    clock_of,
)
from saga_fg.tables.conventions import Sample, findings_of
from saga_fg.tables.units import Clock
from saga_fg.types import Boxes, Coordinates, Detections, Finding, Frame, Mend, Scene, refuse_contradictions

_COORDINATES = ("world", "ego", "sensor", "camera")
JUDGED = 3  # scenes of a table


class DetectionTable:
    """The scenes of one table of detections; `saga_fg.track` has the columns.

    A scene's moments are all times at which some sensor spoke; without pose columns its poses are the identity.
    """

    def __init__(self, raw: RawTable, judged: bool = True) -> None:
        """Check everything. Raises `InputError` naming file, row and column.

        judged: whether its first scenes are to have their `findings`
        """
        if raw.length == 0:
            raise InputError(f"{raw.path}: expected at least one row, the table is empty")
        raw.check_numbers(("timestamp", "x", "y", *BOX, *COVARIANCE, *POSE, *ODOMETRY, *GPS))
        self._raw, self._judged, self._time = raw, judged, raw.numbers("timestamp")
        _require(raw, np.isfinite(self._time), "timestamp", self._time, "a finite number of seconds")
        self._scene, self._sensor = raw.texts("scene", raw.path.stem), raw.texts("sensor", "sensor")
        _check_order(raw, self._scene, self._time)
        self._empty = raw.flags("empty") | (~raw.present("x") & ~raw.present("y")) | raw.labels()[1]
        given = raw.texts("coordinates", raw.how.coordinates or "world")
        expected = f"coordinates: expected {', '.join(_COORDINATES[:-1])} or {_COORDINATES[-1]}"
        refuse(~np.isin(given, _COORDINATES), lambda row: raw.fault(row, f"{expected}, got {str(given[row])!r}"))
        self._ego = EgoColumns.from_table(raw)
        self._pose = _pose(raw, given, self._ego is not None)
        of_camera = given == "camera"
        self._coordinates = np.where(of_camera, "ego", given)
        found = box_columns(raw, self._empty)
        boxes = _from_camera(found.boxes, of_camera) if of_camera.any() else found.boxes
        self._detections = replace(found, boxes=boxes, position_covariance=_covariances(raw, self._empty))
        self.with_poses = self._pose is not None
        names, first = np.unique(self._scene, return_index=True)
        self.scenes: tuple[str, ...] = tuple(names[np.argsort(first)].tolist())

    def scene(self, name: str) -> Scene:
        """One of the scenes; raises `InputError` for an unknown name."""
        path = self._raw.path
        if name not in self.scenes:
            raise InputError(f"{path}: {unknown_name('scene', name, self.scenes)}")
        rows = np.flatnonzero(self._scene == name)
        times, moment = np.unique(self._time[rows], return_inverse=True)
        with error_context(f"{path}: scene {name}"):
            poses = self._poses(rows, moment, len(times))
            world_T_ego = np.eye(4) if poses is None else poses
            frames, kept, firsts = self._frames(rows, moment, poses)
            findings = self._findings(frames, kept, firsts) if self._judged and name in self.scenes[:JUDGED] else ()
            return Scene(name, times, world_T_ego, frames=frames, findings=findings)

    def _findings(self, frames: list[Frame], rows: IntArray, firsts: IntArray) -> tuple[Finding, ...]:
        """Findings about the table and a scene; rows (N,): of its detections, firsts (F,): first row of each frame."""
        raw = self._raw
        ego_yaw = raw.numbers("ego_yaw")[firsts]
        found = [*raw.findings(), *findings_of(Sample.from_frames(frames, raw.numbers("yaw")[rows], ego_yaw))]
        if "coordinates" in raw.columns:  # which no option replaces
            left_out = Mend(columns={"coordinates": ""})
            found = [replace(f, mend=f.mend | left_out) if f.mend and f.mend.coordinates else f for f in found]
        judged = raw.how.judged(found, raw.found.names, raw.within)
        return tuple(replace(finding, what=f"{raw.path}: {finding.what}") for finding in judged)

    def _poses(self, rows: IntArray, moment: IntArray, count: int) -> FloatArray | None:
        """world_T_ego (K, 4, 4) of the moments of a scene, None without pose columns."""
        if self._pose is None:
            return None
        pose = self._pose[rows]
        _, first = np.unique(moment, return_index=True)
        other = (pose != pose[first][moment]).any(axis=1)
        expected = f"{', '.join(POSE)}: expected one pose at one time, got another"
        refuse(other, lambda row: self._raw.fault(int(rows[row]), expected))
        return np.array([yaw_transform(*pose[k]) for k in first.tolist()]).reshape(count, 4, 4)

    def _frames(
        self, rows: IntArray, moment: IntArray, poses: FloatArray | None
    ) -> tuple[list[Frame], IntArray, IntArray]:
        """The frames of a scene, the rows (N,) of their detections in this order, and the first row (F,) of each."""
        kept, firsts, frames = [], [], []
        sensors, sensor = np.unique(self._sensor[rows], return_inverse=True)
        key = moment * len(sensors) + sensor
        order = np.argsort(key, kind="stable")
        starts = np.flatnonzero(np.diff(key[order], prepend=-1))
        for group in np.split(order, starts[1:]):
            k, members = int(moment[group[0]]), rows[group]
            kind = self._coordinates[members]
            other = members[kind != kind[0]]
            if len(other):
                raise self._raw.fault(int(other[0]), "coordinates: expected the same in all rows of a frame")
            kept.append(members[~self._empty[members]])
            firsts.append(members[0])
            frames.append(
                Frame(
                    timestamp=float(self._time[members[0]]),
                    sensor=str(self._sensor[members[0]]),
                    detections=self._detections.select(kept[-1]),
                    world_T_ego=None if poses is None else poses[k],
                    coordinates=cast(Coordinates, str(kind[0])),
                    ego=None if self._ego is None else self._ego.measured(members),
                )
            )
        return frames, np.concatenate(kept), np.array(firsts)


def _check_order(raw: RawTable, scene: StrArray, timestamp: FloatArray) -> None:
    order = np.argsort(scene, kind="stable")
    late = (np.diff(timestamp[order]) < 0) & (scene[order][1:] == scene[order][:-1])
    expected = f"{raw.title('timestamp')}: expected rows in order of time, time runs backwards at"
    mend = "--sort sorts them, --columns scene=NAME tells recordings apart"
    refuse(late, lambda k: raw.fault(int(order[k + 1]), f"{expected} {timestamp[order[k + 1]]} s; {mend}"))


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


def _covariances(raw: RawTable, empty: BoolArray) -> FloatArray:
    """(N, 2, 2) covariance of the position, NaN where none was reported."""
    xx, xy, yy = (raw.numbers(name) for name in COVARIANCE)
    given = ~empty & ~(np.isnan(xx) & np.isnan(xy) & np.isnan(yy))
    bad = given & ~((xx > 0) & (yy > 0) & (xx * yy > xy**2))
    expected = f"{', '.join(COVARIANCE)}: expected a positive definite matrix"
    refuse(bad, lambda row: raw.fault(row, f"{expected}, got {xx[row]:g}, {xy[row]:g}, {yy[row]:g}"))
    return from_upper_triangle(np.where(given, [xx, xy, yy], np.nan).T)


def _from_camera(boxes: Boxes, rows: BoolArray) -> Boxes:
    """Boxes, of which those at `rows` are of a camera (x to the right, y down, z ahead, yaw about y from x), ahead."""
    right, down, ahead = boxes.position.T
    position = np.where(rows[:, None], np.column_stack([ahead, -right, -down]), boxes.position)
    yaw = np.where(rows, -boxes.yaw - np.pi / 2, boxes.yaw)
    velocity = np.where(rows[:, None], np.nan, boxes.velocity)  # of which nobody knows the part ahead
    return Boxes(boxes.label, position, boxes.size, yaw, velocity)


def _pose(raw: RawTable, coordinates: StrArray, estimated: bool) -> FloatArray | None:
    """(N, 4); None where there are none, as there may where the vehicle's own measurements stand in for them."""
    given = [name for name in POSE if raw.present(name).any()]
    if not given:
        needed = "needs the columns ego_x, ego_y and ego_yaw"
        alone = (coordinates != "world") & (not estimated)
        refuse(alone, lambda row: raw.fault(row, f"coordinates: {coordinates[row]} {needed}"))
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


def sorted_by_time(table: RawTable) -> RawTable:
    """The rows of a table in order of time within each scene; scenes, and rows of one time, stay in their order."""
    _, first, scene = np.unique(table.texts("scene", ""), return_index=True, return_inverse=True)
    order = np.lexsort((table.numbers("timestamp"), first[scene]))
    columns: dict[str, Values] = {
        name: values[order] if isinstance(values, np.ndarray) else [values[row] for row in order.tolist()]
        for name, values in table.columns.items()
    }
    return replace(table, columns=columns, where=lambda row: table.where(int(order[row])), _read={})


Table = Any
"""A `pandas.DataFrame`, `polars.DataFrame` or `pyarrow.Table`; none of them need be installed."""

NAME = "table"  # in errors


def raw_table(
    table: Table,
    how: TableImport | None = None,
    columns: Sequence[str] = COLUMNS,
    required: Sequence[str] = REQUIRED,
    within: str = "how",
    lenient: bool = False,
) -> RawTable:
    """Return the columns of a table that have a meaning among `columns`, in order of time if they have times.

    how     what it takes to understand it; what is left out is found by the names of the columns
    within  the argument of the program that is `how`
    lenient whether columns that `how` names need not be there, as none that has no meaning here

    Raises `InputError` for something else, and for columns that are missing, misspelt, or could be either of two.
    """
    import narwhals as nw

    try:
        frame = nw.from_native(table, eager_only=True)
        names = [name for name in frame.columns if isinstance(name, str)]
        frame = frame.select(names)
    except TypeError as error:
        expected = "expected a table of pandas, Polars or Arrow"
        raise InputError(f"{expected}, got {type(table).__name__}") from error
    except nw.exceptions.NarwhalsError as error:
        raise InputError(f"{NAME}: expected every column once: {str(error).splitlines()[0]}") from error
    how = TableImport() if how is None else how
    require_type("how", how, TableImport)
    found = understood(names, columns, required, how.naming(columns), lenient, within)
    if found.faults:
        raise InputError(f"{NAME}: {'; '.join(found.faults)}")
    index, clock = nw.maybe_get_index(frame), None
    values: dict[str, Values] = {}
    for ours, theirs in found.names.items():
        column = frame[theirs]
        if isinstance(column.dtype, nw.Datetime | nw.Duration):
            is_time = isinstance(column.dtype, nw.Datetime)
            column, clock = column.dt.timestamp("ns") if is_time else column.dt.total_nanoseconds(), Clock("ns")
        values[ours] = as_names(_plain(column)) if ours in NAMED else _plain(column)

    def where(row: int) -> str:
        return f"row {row if index is None else index[row]}"

    raw = RawTable(Path(NAME), values, len(frame), where, False, found, how, within=within)
    raw = replace(raw, clock=clock or (clock_of(raw) if len(frame) else Clock()))
    return sorted_by_time(raw) if "timestamp" in values and len(frame) else raw


def _plain(column: Any) -> list[Any]:
    """Plain values of a column; None where one is missing."""
    missing = column.is_null().to_list()
    values = [value.item() if isinstance(value, np.generic) else value for value in column.to_list()]
    return [None if gone or value != value else value for value, gone in zip(values, missing, strict=True)]


def scenes_of(raw: RawTable) -> list[Scene]:
    """The recordings of a table of detections. Raises `InputError` naming row and column."""
    if raw.length == 0:
        return []
    table = DetectionTable(raw)
    return [table.scene(name) for name in table.scenes]


def frames_of(table: Table, how: TableImport | None = None) -> list[Frame]:
    """The frames of a table of detections of one recording, in order of time; `saga_fg.track` has the columns.

    Rows with the same time and sensor are a frame. Warns and raises as `saga_fg.track`, and for several recordings.
    """
    raw = raw_table(table, how)
    scenes = scenes_of(raw)
    if len(scenes) > 1:
        raise InputError(f"{NAME}: scene: expected one recording, got {', '.join(each.name for each in scenes[:6])}")
    tell([finding for scene in scenes for finding in scene.findings or ()], raw, 3)
    return [frame for scene in scenes for frame in scene.frames]


def tell(findings: Sequence[Finding], raw: RawTable, depth: int) -> None:
    """Warn of what is doubtful in a table, `depth` callers up, each kind once.

    Raises `InputError` for all that contradicts how it is read, with the arguments that mend it.
    """
    known = {finding.kind: finding for finding in reversed(findings)}
    found = [replace(each, what=each.what.removeprefix(f"{NAME}: ")) for each in known.values()]
    refuse_contradictions(found, option_text({"as_given": True}, raw.within))
    for each in found:
        warnings.warn(str(each), stacklevel=depth)
    if raw.clock.guessed:
        unit = raw.clock.unit
        says = option_text({"units": {"time": unit}}, raw.within)
        warnings.warn(f"times are read as {unit}, by their size; {says} says so", stacklevel=depth)


def table_like(table: Table, parts: Sequence[Mapping[str, Any]]) -> Table:
    """Return a table of the same kind of columns that are given in parts, of which there is one at least."""
    import narwhals as nw

    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    backend = nw.from_native(table, eager_only=True).implementation
    listed = {name: each.tolist() if each.dtype.kind == "U" else each for name, each in columns.items()}
    return nw.from_dict(listed, backend=backend).to_native()

"""Argoverse 2 sensor logs with annotations, detections and vector maps in; `Scene`s out.

A log without annotations, as of the test split, has no moments of its own.

    LOG/annotations.feather            timestamp_ns, track_uuid, category, length_m, width_m, height_m,
                                       qw, qx, qy, qz, tx_m, ty_m, tz_m (in the ego frame), num_interior_pts
    LOG/city_SE3_egovehicle.feather    timestamp_ns, qw, qx, qy, qz, tx_m, ty_m, tz_m

A moment is an annotated time (10 Hz). World coordinates are the city's; a box is visible if points lie inside. Classes
are those of `CLASSES`, and the category in lower case where it is not there.

Source: Wilson et al., Argoverse 2, NeurIPS 2021 datasets track; https://argoverse.github.io/user-guide/. Feather
needs pyarrow (extra [parquet]).

The vector maps of Argoverse 2 logs, where they are there: LOG/map/log_map_archive_*.json.

    {"drivable_areas": {ID: {"area_boundary": [POINT, ...]}},
     "pedestrian_crossings": {ID: {"edge1": [POINT, POINT], "edge2": [POINT, POINT]}},
     "lane_segments": {ID: {"left_lane_boundary": [POINT, ...], "right_lane_boundary": [POINT, ...]}}}

POINT is {"x", "y", "z"}, m, in the frame of the city. Format: https://argoverse.github.io/user-guide/api/hd_maps.html.

Logs with detections: a Feather file of Argoverse's detection task, a table, or what is annotated and visible.

    log_id, timestamp_ns, category, score, length_m, width_m, height_m, qw, qx, qy, qz, tx_m, ty_m, tz_m

in the frame of the vehicle, one row a box, of any number of logs. Each time of a log is a frame; where the file has
boxes at half of the annotated times or more, the others are frames without detections.

Source: https://argoverse.github.io/user-guide/tasks/3d_object_detection.html, "Submission format".
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.datasets.given_tracks import DetectedScenes
from data_tools.datasets.source import AreaMap, Kind, map_points
from data_tools.files import WHOLE, arrow_arrays, parsed_json, read_bytes
from data_tools.trajectories import central_differences
from saga_fg.errors import InputError, error_context, unknown_name
from saga_fg.numerics import (
    FloatArray,
    IntArray,
    StrArray,
    checked,
    checked_quaternions,
    quaternion_rotation,
    refuse,
    rigid_transforms,
    yaw_of,
)
from saga_fg.tables import DetectionTable
from saga_fg.types import Annotations, Boxes, Detections, Frame, Scene

CLASSES = {
    "REGULAR_VEHICLE": "car",
    "LARGE_VEHICLE": "truck",
    "BOX_TRUCK": "truck",
    "TRUCK": "truck",
    "TRUCK_CAB": "truck",
    "BUS": "bus",
    "SCHOOL_BUS": "bus",
    "ARTICULATED_BUS": "bus",
    "VEHICULAR_TRAILER": "trailer",
}
POSE = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
SIZE = ("length_m", "width_m", "height_m")
_ANNOTATIONS = ("timestamp_ns", "track_uuid", "category", *SIZE, *POSE, "num_interior_pts")
FILES = ("annotations.feather", "city_SE3_egovehicle.feather")
KINDS = {
    **dict.fromkeys(("timestamp_ns", "track_id"), WHOLE),
    **dict.fromkeys(("track_uuid", "category", "log_id"), "OU"),
}  # of NumPy, of columns that are no numbers
_LONGEST_GAP = 0.5  # s between boxes of an object, for a velocity
_REACH = 2  # moments to either side, for a velocity


@dataclass(frozen=True, eq=False)
class ArgoverseScene(Scene):
    """A log; categories: of the detections of each frame, (n,), in the words of Argoverse."""

    categories: Sequence[StrArray] = ()


class ArgoverseLogs:
    """The logs below `root`: folders with city_SE3_egovehicle.feather and, but for the test split, annotations.feather.

    Files are read when asked for. Raises `InputError` for a root without any.
    """

    def __init__(self, root: str | Path) -> None:
        self._root = Path(root)
        files = [path for name in FILES for path in self._root.glob(f"*/{name}")]
        self.scenes = tuple(sorted({path.parent.name for path in files}))
        if not self.scenes:
            if not self._root.is_dir():
                raise InputError(f"{self._root}: expected the folder of the logs, there is no such folder")
            if any((self._root / name).is_file() for name in FILES):
                raise InputError(
                    f"{self._root}: expected the folder of the logs, this is one log: give {self._root.parent}"
                )
            raise InputError(f"{self._root}: expected LOG/annotations.feather, there is none")

    def annotated(self, name: str) -> bool:
        """True if a log has annotations."""
        return (self._root / name / FILES[0]).is_file()

    def scene(self, name: str) -> ArgoverseScene:
        """Read a log with annotations; its frames are none, its categories those of the annotations.

        Raises `InputError` for an unknown name, a missing column, or a time without a pose.
        """
        if name not in self.scenes:
            raise InputError(f"{self._root}: {unknown_name('log', name, self.scenes)}")
        path = self._root / name / "annotations.feather"
        rows = arrow_arrays(path, _ANNOTATIONS, KINDS)
        stamp: IntArray = rows["timestamp_ns"]
        stamps, moment = np.unique(stamp, return_inverse=True)
        poses = self.poses(name, stamps)
        with error_context(str(path)):
            ego_T_box = transforms(rows)
            boxes = boxes_of(rows, poses[moment] @ ego_T_box)
            category, ids = rows["category"].astype(np.str_), rows["track_uuid"].astype(np.str_)
            time = (stamps - stamps[0]) * 1e-9 if len(stamps) else np.empty(0)
            velocity = central_differences(ids, time[moment], boxes.position[:, :2], _LONGEST_GAP, _REACH)
            boxes = replace(boxes, velocity=velocity)
            seen = rows["num_interior_pts"] > 0
            of_moment = [np.flatnonzero(moment == k) for k in range(len(stamps))]
            truth = [Annotations(ids[at], boxes.select(at), seen[at]) for at in of_moment]
        categories = [category[at] for at in of_moment]
        tokens = tuple(map(str, stamps.tolist()))
        return ArgoverseScene(name, time, poses, tokens, [], truth, categories=categories)

    def poses(self, name: str, stamps: IntArray) -> FloatArray:
        """city_T_ego (K, 4, 4) at some times, ns. Raises `InputError` for one without a pose."""
        path = self._root / name / "city_SE3_egovehicle.feather"
        rows = arrow_arrays(path, ("timestamp_ns", *POSE), KINDS)
        order = np.argsort(rows["timestamp_ns"])
        known = rows["timestamp_ns"][order]
        at = np.minimum(np.searchsorted(known, stamps), max(len(known) - 1, 0))
        absent = known[at] != stamps if len(known) else np.ones(len(stamps), dtype=bool)
        expected = f"{path}: timestamp_ns: expected a pose at every time of boxes"
        refuse(absent, lambda row: InputError(f"{expected}, {stamps[row]} has none"))
        with error_context(str(path)):
            return transforms(rows)[order][at]


def boxes_of(rows: Mapping[str, Any], frame_T_box: FloatArray) -> Boxes:
    """The boxes of rows at their poses (N, 4, 4), of unknown velocity. Raises `InputError` for scores that are none."""
    if not np.isfinite(rows.get("score", np.empty(0)).astype(np.float64)).all():
        raise InputError("score: expected finite numbers")
    label = np.array([CLASSES.get(each, each.lower()) for each in rows["category"].tolist()], dtype=np.str_)
    size = np.stack([rows[name] for name in SIZE], axis=1).astype(np.float64)
    return Boxes.of(label, frame_T_box[:, :3, 3], size, yaw_of(frame_T_box[:, :3, :3]))


def transforms(rows: dict[str, Any]) -> FloatArray:
    """(N, 4, 4) of the pose columns."""
    quaternion, translation = (np.stack([rows[name] for name in names], axis=1) for names in (POSE[:4], POSE[4:]))
    rotation = quaternion_rotation(checked_quaternions("qw qx qy qz", quaternion))
    return rigid_transforms(rotation, checked("tx_m ty_m tz_m", translation, (len(rotation), 3)))


BORDERS = ("left_lane_boundary", "right_lane_boundary")


def argoverse_maps(root: Path, scenes: Mapping[str, Scene]) -> dict[str, AreaMap]:
    """Return the maps of logs that have one. Raises `InputError` for a broken one."""
    found = {}
    for name, scene in scenes.items():
        for path in sorted((root / name / "map").glob("log_map_archive_*.json"))[:1]:
            raw = parsed_json(read_bytes(path), str(path))
            try:
                found[name] = AreaMap.around(scene, list(_areas(raw)), list(_borders(raw)))
            except (KeyError, TypeError, ValueError, AttributeError) as error:
                raise InputError(f"{path}: expected a map of Argoverse 2: {error!r}") from error
    return found


def _areas(raw: Any) -> Iterator[tuple[Kind, Sequence[FloatArray]]]:
    for area in raw["drivable_areas"].values():
        yield "drivable", [_points(area["area_boundary"])]
    for crossing in raw["pedestrian_crossings"].values():
        near, far = _points(crossing["edge1"]), _points(crossing["edge2"])
        yield "crossing", [np.concatenate([near, far[::-1]])]


def _borders(raw: Any) -> Iterator[FloatArray]:
    for lane in raw["lane_segments"].values():
        for border in BORDERS:
            yield _points(lane[border])


def _points(points: Any) -> FloatArray:
    return map_points([(point["x"], point["y"]) for point in points])


SENSOR = "lidar"
COLUMNS = ("log_id", "timestamp_ns", "category", "score", *SIZE, *POSE)
_NO_LABELS: StrArray = np.empty(0, dtype=np.str_)


class AnnotatedLogs:
    """Logs with their annotations or a table as detections; a table's classes may be categories."""

    def __init__(self, logs: ArgoverseLogs, table: DetectionTable | None) -> None:
        self._logs, self._table = logs, table
        self.scenes = logs.scenes

    def scene(self, name: str) -> ArgoverseScene:
        """Read a log; raises `InputError` where it has no annotations, or the table does not have it."""
        scene = self._logs.scene(name)
        found = DetectedScenes(self._logs, self._table).scene(name)
        if self._table is not None:
            categories = [frame.detections.boxes.label for frame in found.frames]
            return replace(scene, frames=found.frames, categories=categories)
        assert scene.ground_truth is not None
        seen = [of[truth.visible] for of, truth in zip(scene.categories, scene.ground_truth, strict=True)]
        by_time = dict(zip(scene.timestamps.tolist(), seen, strict=True))
        categories = [by_time.get(frame.timestamp, _NO_LABELS) for frame in found.frames]
        return replace(scene, frames=found.frames, categories=categories)


class DetectedLogs:
    """Logs with the boxes of a Feather file of detections; the scenes are the logs of the file.

    Raises `InputError` for an invalid file, a missing column, a score or box that is no number, and for a log that
    is not there.
    """

    def __init__(self, logs: ArgoverseLogs, path: str | Path) -> None:
        self._logs, self._path = logs, Path(path)
        self._rows = arrow_arrays(self._path, COLUMNS, KINDS)
        self._log: StrArray = self._rows["log_id"].astype(np.str_)
        names = tuple(dict.fromkeys(self._log.tolist()))
        self.scenes = tuple(name for name in logs.scenes if name in set(names))
        if not self.scenes:
            more = f" and {len(names) - 1} more" if len(names) > 1 else ""
            there = f"{names[0]}{more}" if names else "none"
            raise InputError(f"{path}: log_id: expected one of the logs, such as {logs.scenes[0]}, got {there}")

    def scene(self, name: str) -> ArgoverseScene:
        """Read a log. Its moments are the annotated times, and those of the boxes where nothing is annotated."""
        mine = np.flatnonzero(self._log == name)
        rows = {column: values[mine] for column, values in self._rows.items()}
        stamp: IntArray = rows["timestamp_ns"].astype(np.int64)
        scene = self._logs.scene(name) if self._logs.annotated(name) else self._unannotated(name, np.unique(stamp))
        annotated: IntArray = np.array(scene.tokens, dtype=np.int64)
        times = np.unique(stamp)
        if np.isin(annotated, times).mean() >= 0.5:
            times = np.union1d(times, annotated)
        poses = self._logs.poses(name, times)
        with error_context(f"{self._path}: log {name}"):
            found = Detections(boxes_of(rows, transforms(rows)), rows["score"].astype(np.float64))
            category: StrArray = rows["category"].astype(np.str_)
            frames, categories = [], []
            order = np.argsort(stamp, kind="stable")
            bounds = (
                np.searchsorted(stamp[order], times, side="left"),
                np.searchsorted(stamp[order], times, side="right"),
            )
            for time, pose, start, end in zip(times.tolist(), poses, *(each.tolist() for each in bounds), strict=True):
                at = order[start:end]
                seconds = (time - int(annotated[0])) * 1e-9
                frames.append(Frame(seconds, SENSOR, found.select(at), pose, "ego", str(time)))
                categories.append(category[at])
        return replace(scene, frames=frames, categories=categories)

    def _unannotated(self, name: str, times: IntArray) -> ArgoverseScene:
        seconds = (times - times[0]) * 1e-9
        return ArgoverseScene(name, seconds, self._logs.poses(name, times), tuple(map(str, times.tolist())), [])

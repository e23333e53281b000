"""Logs with detections: a Feather file of Argoverse's detection task, a table, or what is annotated and visible.

    log_id, timestamp_ns, category, score, length_m, width_m, height_m, qw, qx, qy, qz, tx_m, ty_m, tz_m

in the frame of the vehicle, one row a box, of any number of logs. Each time of a log is a frame; where the file has
boxes at half of the annotated times or more, the others are frames without detections.

Source: https://argoverse.github.io/user-guide/tasks/3d_object_detection.html, "Submission format".
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from data_tools.datasets.annotated import DetectedScenes
from data_tools.datasets.argoverse2.logs import (
    POSE,
    SIZE,
    ArgoverseLogs,
    ArgoverseScene,
    class_names,
    columns_of,
    transforms,
)
from data_tools.datasets.detection_files import DetectionFile
from data_tools.files.error_messages import error_context
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import IntArray, StrArray
from saga_fg.numerics.geometry import yaw_of
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections, Frame

SENSOR = "lidar"
COLUMNS = ("log_id", "timestamp_ns", "category", "score", *SIZE, *POSE)
_NONE: StrArray = np.empty(0, dtype=np.str_)


class AnnotatedLogs:
    """Logs with their annotations or a table as detections; a table's classes may be categories."""

    def __init__(self, logs: ArgoverseLogs, table: DetectionFile | None) -> None:
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
        categories = [by_time.get(frame.timestamp, _NONE) for frame in found.frames]
        return replace(scene, frames=found.frames, categories=categories)


class DetectedLogs:
    """Logs with the boxes of a Feather file of detections; the scenes are the logs of the file.

    Raises `InputError` for an invalid file, a missing column, a score or box that is no number, and for a log that
    is not there.
    """

    def __init__(self, logs: ArgoverseLogs, path: str | Path) -> None:
        self._logs, self._path = logs, Path(path)
        self._rows = columns_of(self._path, COLUMNS)
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
            score = rows["score"].astype(np.float64)
            if not np.isfinite(score).all():
                raise InputError("score: expected finite numbers")
            ego_T_box = transforms(rows)
            size = np.stack([rows[column] for column in SIZE], axis=1).astype(np.float64)
            category: StrArray = rows["category"].astype(np.str_)
            boxes = Boxes.of(class_names(category), ego_T_box[:, :3, 3], size, yaw_of(ego_T_box[:, :3, :3]))
            found = Detections(boxes, score)
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


def is_feather(path: str) -> bool:
    """True for the name of a file of Argoverse's detection task."""
    return path.endswith(".feather")

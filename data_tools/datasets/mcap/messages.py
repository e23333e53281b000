"""The types of messages that hold objects or poses, and the tree of coordinate frames.

A tree of coordinate frames whose edges move: the transforms of a recording, looked up at any time.

    target_T_source(t) = product of the edges between both, each interpolated at t

Translations are interpolated linearly, rotations by normalised linear interpolation of quaternions. Edges hold beyond
their ends for `HOLD`, and over gaps of `LONGEST_GAP`; farther away they are unknown.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, cast

import numpy as np

from data_tools.datasets.mcap import autoware, scene_update, vision
from data_tools.datasets.mcap.objects import MessageType, checked_time, frame_name, nanoseconds, wxyz, xyz
from data_tools.datasets.mcap.recording import LoggedMessage, Recording, Topic, decoded_messages
from data_tools.files.input_files import error_context
from data_tools.files.isolated_reading import isolated
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, checked
from saga_fg.numerics.geometry import checked_quaternions, inverse_transform, quaternion_rotation

HOLD = 0.1  # s
LONGEST_GAP = 1.0  # s


class TransformRecord(NamedTuple):
    """parent_T_child at a time, ns: translation (x, y, z), m, rotation (w, x, y, z); `where` it comes from."""

    parent: str
    child: str
    static: bool
    time: int
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]
    where: str


@dataclass(frozen=True, eq=False)
class _Edge:
    """parent_T_child at K times (ns): translations (K, 3), quaternions (K, 4); static: of all times."""

    parent: str
    static: bool
    time: IntArray
    translation: FloatArray
    rotation: FloatArray

    def at(self, time: IntArray) -> tuple[FloatArray, BoolArray]:
        """(N, 4, 4) at some times, ns, and where they are known."""
        n, last = len(time), len(self.time) - 1
        after = np.clip(np.searchsorted(self.time, time), 1, max(last, 1))
        after, before = np.minimum(after, last), np.minimum(after - 1, last)
        span = self.time[after] - self.time[before]
        share = np.clip((time - self.time[before]) / np.maximum(span, 1), 0, 1)[:, None]
        a, b = self.rotation[before], self.rotation[after]
        b = np.where((a * b).sum(axis=1, keepdims=True) < 0, -b, b)
        quaternion = (1 - share) * a + share * b
        T = np.tile(np.eye(4), (n, 1, 1))
        T[:, :3, :3] = quaternion_rotation(quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True))
        T[:, :3, 3] = (1 - share) * self.translation[before] + share * self.translation[after]
        if self.static:
            return T, np.ones(n, dtype=bool)
        beyond = np.maximum(self.time[0] - time, time - self.time[-1]) > HOLD * 1e9
        inside = (time > self.time[before]) & (time < self.time[after])
        return T, ~beyond & ~(inside & (span > LONGEST_GAP * 1e9))


class TransformTree:
    """All transforms of a recording. Raises `InputError` for an invalid one, naming its place.

    The parent of a frame is the one that most of its transforms name.
    """

    def __init__(self, records: Iterable[TransformRecord]) -> None:
        of_child: dict[str, list[TransformRecord]] = {}
        for record in records:
            of_child.setdefault(record.child, []).append(record)
        self._edges = {child: _edge(rows) for child, rows in of_child.items()}
        self.contested = {
            child: tuple(parents)
            for child, rows in of_child.items()
            if len(parents := dict.fromkeys(row.parent for row in rows)) > 1
        }

    def __len__(self) -> int:
        return len(self._edges)

    @property
    def frames(self) -> tuple[str, ...]:
        """The names of all frames, sorted."""
        return tuple(sorted({*self._edges, *(edge.parent for edge in self._edges.values())}))

    def root(self, frame: str) -> str:
        """The frame at the top of the tree that a frame is in."""
        return self._upwards(frame)[-1]

    def connected(self, a: str, b: str) -> bool:
        """True if both frames are in one tree."""
        return self.root(a) == self.root(b)

    def lookup(self, target: str, source: str, time: IntArray) -> tuple[FloatArray, BoolArray]:
        """target_T_source (N, 4, 4) at some times (N,), ns, and where it is known; the frames are connected."""
        up, down = self._upwards(source), self._upwards(target)
        common = next(frame for frame in up if frame in down)
        to_source, a = self._below(common, up, time)
        to_target, b = self._below(common, down, time)
        return inverse_transform(to_target) @ to_source, a & b

    def _below(self, ancestor: str, upwards: list[str], time: IntArray) -> tuple[FloatArray, BoolArray]:
        """ancestor_T_frame of the frame that the way up begins at."""
        T, known = np.tile(np.eye(4), (len(time), 1, 1)), np.ones(len(time), dtype=bool)
        for child, _ in pairwise(upwards[: upwards.index(ancestor) + 1]):
            parent_T_child, there = self._edges[child].at(time)
            T, known = parent_T_child @ T, known & there
        return T, known

    def _upwards(self, frame: str) -> list[str]:
        """The frame, its parent, and so on; raises `InputError` for a circle."""
        way = [frame]
        while (edge := self._edges.get(way[-1])) is not None:
            if edge.parent in way:
                raise InputError(f"transforms: expected a tree of frames, got the circle {' -> '.join(way)}")
            way.append(edge.parent)
        return way


def _edge(rows: list[TransformRecord]) -> _Edge:
    parent = Counter(row.parent for row in rows).most_common(1)[0][0]
    rows = [row for row in rows if row.parent == parent]
    static = all(row.static for row in rows)
    rows = rows[-1:] if static else rows
    time: IntArray = np.array([row.time for row in rows], dtype=np.int64)
    _, first = np.unique(time, return_index=True)
    try:
        translation = checked("translation", [row.translation for row in rows], (len(rows), 3))
        rotation = checked_quaternions("rotation", [row.rotation for row in rows])
    except InputError:
        for row in rows:  # find the one it is about
            where = f"{row.where}: transform of {row.child}"
            checked(f"{where}: translation", [row.translation], (1, 3))
            checked_quaternions(f"{where}: rotation", [row.rotation])
        raise
    return _Edge(parent, static, time[first], translation[first], rotation[first])


MODULES: tuple[ModuleType, ...] = (autoware, vision, scene_update)
OBJECT_TYPES: dict[str, MessageType] = {name: cast(MessageType, module) for module in MODULES for name in module.TYPES}
TRANSFORM_TYPES = ("tf2_msgs/TFMessage", "foxglove.FrameTransforms", "foxglove.FrameTransform")
ODOMETRY_TYPES = ("nav_msgs/Odometry",)
DEFAULT_EGO = "base_link"


def recorded_messages(recording: Recording, topics: Collection[str]) -> Iterator[LoggedMessage]:
    """The messages of some topics, in the order of the files, read in a child process.

    Each has its `ObjectRows`, with a stamp, or a list of its `TransformRecord`s as the message. Raises `InputError`
    naming file, topic, message and field.
    """
    return isolated("not readable", _contents, recording.path, recording.files, recording.chosen(topics))


def _contents(path: Path, files: Sequence[Path], topics: Mapping[str, Topic]) -> Iterator[LoggedMessage]:
    for logged in decoded_messages(files, topics):
        with error_context(f"{path}: {logged.topic.name}: message {logged.number}"):
            try:
                if logged.topic.type in OBJECT_TYPES:
                    content: Any = OBJECT_TYPES[logged.topic.type].rows(logged.message)
                    content.stamp = content.stamp or checked_time(logged.log_time)
                else:
                    content = list(transform_records(logged))
            except AttributeError as error:
                raise InputError(
                    f"{error.name}: expected this field in {logged.topic.type}, its definition here has none"
                ) from error
        yield replace(logged, message=content)


def transform_records(logged: LoggedMessage) -> Iterator[TransformRecord]:
    """The transforms of a message of one of the `TRANSFORM_TYPES`, or of an odometry."""
    message, where = logged.message, f"{logged.topic.name}: message {logged.number}"
    static = logged.topic.name.endswith("tf_static")
    if logged.topic.type in ODOMETRY_TYPES:
        pose = message.pose.pose
        child = frame_name(message.child_frame_id) or DEFAULT_EGO
        places = xyz(pose.position), wxyz(pose.orientation)
        yield TransformRecord(
            frame_name(message.header.frame_id), child, False, _time(message.header.stamp, logged), *places, where
        )
    elif logged.topic.type == "tf2_msgs/TFMessage":
        for each in message.transforms:
            names = frame_name(each.header.frame_id), frame_name(each.child_frame_id)
            places = xyz(each.transform.translation), wxyz(each.transform.rotation)
            yield TransformRecord(*names, static, _time(each.header.stamp, logged), *places, where)
    else:
        for each in getattr(message, "transforms", [message]):
            names = frame_name(each.parent_frame_id), frame_name(each.child_frame_id)
            places = xyz(each.translation), wxyz(each.rotation)
            yield TransformRecord(*names, static, _time(each.timestamp, logged), *places, where)


def _time(stamp: Any, logged: LoggedMessage) -> int:
    return nanoseconds(stamp) or checked_time(logged.log_time)

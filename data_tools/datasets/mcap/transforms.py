"""Transforms between coordinate frames, of a recording or live, and the places of vehicle and sensors by them.

Transforms are a tree of coordinate frames whose edges move, looked up at any time:

    target_T_source(t) = product of the edges between both, each interpolated at t

Translations are interpolated linearly, rotations by normalised linear interpolation of quaternions. Edges hold beyond
their ends for `HOLD`, and over gaps of `LONGEST_GAP`; farther away they are unknown.
"""

from bisect import bisect_left, bisect_right, insort
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from data_tools.datasets.mcap.recording import LoggedMessage
from data_tools.datasets.mcap.ros2_types import checked_time, frame_name, nanoseconds, wxyz, xyz
from saga_fg.errors import InputError, unknown_name
from saga_fg.numerics import (
    BoolArray,
    FloatArray,
    IntArray,
    checked,
    checked_quaternions,
    inverse_transform,
    quaternion_rotation,
    rigid_transforms,
)

TRANSFORM_TYPES = ("tf2_msgs/TFMessage",)
ODOMETRY_TYPES = ("nav_msgs/Odometry",)
DEFAULT_EGO = "base_link"
WORLD = "map"  # of a live system
HOLD = 0.1  # s
LONGEST_GAP = 1.0  # s
KEPT = 10.0  # s of transforms, as tf2 keeps them
MAX_FRAMES = 1000  # of a live system


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

    def at(self, time: IntArray, hold: float) -> tuple[FloatArray, BoolArray]:
        """(N, 4, 4) at some times, ns, and where they are known; hold: s beyond the ends."""
        last = len(self.time) - 1
        after = np.clip(np.searchsorted(self.time, time), 1, max(last, 1))
        after, before = np.minimum(after, last), np.minimum(after - 1, last)
        span = self.time[after] - self.time[before]
        share = np.clip((time - self.time[before]) / np.maximum(span, 1), 0, 1)[:, None]
        a, b = self.rotation[before], self.rotation[after]
        b = np.where((a * b).sum(axis=1, keepdims=True) < 0, -b, b)
        quaternion = (1 - share) * a + share * b
        rotation = quaternion_rotation(quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True))
        T = rigid_transforms(rotation, (1 - share) * self.translation[before] + share * self.translation[after])
        if self.static:
            return T, np.ones(len(time), dtype=bool)
        beyond = np.maximum(self.time[0] - time, time - self.time[-1]) > hold * 1e9
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

    def moves_in(self, frame: str) -> str | None:
        """The nearest frame above that `frame` moves in; None if it stands still in all."""
        upwards = self._upwards(frame)
        moving = (parent for child, parent in pairwise(upwards) if not self._edges[child].static)
        return next(moving, None)

    def connected(self, a: str, b: str) -> bool:
        """True if both frames are in one tree."""
        return self.root(a) == self.root(b)

    def lookup(self, target: str, source: str, time: IntArray, hold: float = HOLD) -> tuple[FloatArray, BoolArray]:
        """target_T_source (N, 4, 4) at some times (N,), ns, and where it is known; the frames are connected.

        hold  s for which edges hold beyond their ends
        """
        up, down = self._upwards(source), self._upwards(target)
        common = next(frame for frame in up if frame in down)
        to_source, a = self._below(common, up, time, hold)
        to_target, b = self._below(common, down, time, hold)
        return inverse_transform(to_target) @ to_source, a & b

    def _below(self, ancestor: str, upwards: list[str], time: IntArray, hold: float) -> tuple[FloatArray, BoolArray]:
        """ancestor_T_frame of the frame that the chain up begins at."""
        T, known = np.tile(np.eye(4), (len(time), 1, 1)), np.ones(len(time), dtype=bool)
        for child, _ in pairwise(upwards[: upwards.index(ancestor) + 1]):
            parent_T_child, there = self._edges[child].at(time, hold)
            T, known = parent_T_child @ T, known & there
        return T, known

    def _upwards(self, frame: str) -> list[str]:
        """The frame, its parent, and so on; raises `InputError` for a circle."""
        chain = [frame]
        while (edge := self._edges.get(chain[-1])) is not None:
            if edge.parent in chain:
                raise InputError(f"transforms: expected a tree of frames, got the circle {' -> '.join(chain)}")
            chain.append(edge.parent)
        return chain


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


class TransformBuffer:
    """The transforms of a live system: of each frame those of the last `KEPT` s before its newest."""

    def __init__(self) -> None:
        self._of_child: dict[str, list[TransformRecord]] = {}

    def add(self, record: TransformRecord) -> None:
        """Take in a transform; one far older than the newest begins anew. Raises `InputError` for an invalid one."""
        TransformTree([record])
        if len(self._of_child) >= MAX_FRAMES and record.child not in self._of_child:
            raise InputError(f"{record.where}: expected at most {MAX_FRAMES} frames, {record.child} is one more")
        rows = self._of_child.setdefault(record.child, [])
        if rows and (record.static or rows[-1].static or record.time < rows[-1].time - KEPT * 1e9):
            rows.clear()
        insort(rows, record, key=_record_time)
        del rows[: bisect_left(rows, rows[-1].time - int(KEPT * 1e9), key=_record_time)]

    def tree(self, frames: Iterable[str], time: int) -> TransformTree:
        """Return the transforms of some frames, and of those above them, next to a time, ns."""
        needed, records = list(dict.fromkeys(frames)), list[TransformRecord]()
        for frame in needed:  # grows on the way
            rows = self._of_child.get(frame, [])
            after = bisect_right(rows, time, key=_record_time)
            records += (near := rows[max(after - 1, 0) : after + 1])
            needed += dict.fromkeys(row.parent for row in near if row.parent not in needed)
        return TransformTree(records)


def _record_time(record: TransformRecord) -> int:
    return record.time


def transform_records(logged: LoggedMessage) -> Iterator[TransformRecord]:
    """The transforms of a message of one of the `TRANSFORM_TYPES`, or of an odometry."""
    message, where = logged.message, f"{logged.topic.name}: message {logged.number}"
    if logged.topic.type in ODOMETRY_TYPES:
        head, pose = message.header, message.pose.pose
        child = frame_name(message.child_frame_id) or DEFAULT_EGO
        edges = [(head.stamp, head.frame_id, child, pose.position, pose.orientation)]
    else:
        edges = [
            (each.header.stamp, each.header.frame_id, each.child_frame_id, T.translation, T.rotation)
            for each, T in ((each, each.transform) for each in message.transforms)
        ]
    static = logged.topic.name.endswith("tf_static")
    for stamp, parent, child, translation, rotation in edges:
        time = nanoseconds(stamp) or checked_time(logged.log_time)
        places = xyz(translation), wxyz(rotation)
        yield TransformRecord(frame_name(parent), frame_name(child), static, time, *places, where)


@dataclass(frozen=True, eq=False)
class Places:
    """world_T_ego (N, 4, 4) at the N messages, None without a vehicle; which are known; base_T_frame by frame, the
    base being the vehicle, or the world without one.
    """

    world: str
    world_T_ego: FloatArray | None
    known: BoolArray
    base_T_frame: Mapping[str, FloatArray]


def find_places(
    tree: TransformTree, world: str, ego: str | None, frames: Sequence[str], time: IntArray, hold: float = HOLD
) -> Places:
    """Return the places of the vehicle (None: there is none) and of the frames of N messages at their times (N,), ns.

    A frame "" is the world. Raises `InputError` for frames without transforms between them.
    """
    used = dict.fromkeys(frame for frame in frames if frame and frame != world)
    for frame in (*used, *([ego] if ego else [])):
        check_frame(tree, frame)
        if not tree.connected(world, frame):
            raise InputError(f"expected transforms between the frames {world} and {frame}, there are none")
    none = None, np.ones(len(time), dtype=bool)
    world_T_ego, known = tree.lookup(world, ego, time, hold) if ego else none
    base_T_frame: dict[str, FloatArray] = {}
    for frame in used:
        base_T_frame[frame], there = tree.lookup(ego or world, frame, time, hold)
        known = known & (there | [each != frame for each in frames])
    return Places(world, world_T_ego, known, base_T_frame)


def check_frame(tree: TransformTree, frame: str) -> None:
    if not tree.frames:
        raise InputError(f"frame {frame!r}: there are no transforms so far; --world {frame} if it stands still")
    if frame not in tree.frames:
        raise InputError(unknown_name("frame", frame, tree.frames))

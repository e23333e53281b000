"""A recording as a dataset of one scene: the objects of its topics, each topic a sensor, and the pose of the vehicle.

Objects are brought from the frame of their message to the vehicle's by the transforms at the time of the message; the
moments of the scene are these times. The tokens of the moments are the times in ns, as the messages have them.

Transforms are a tree of coordinate frames whose edges move, looked up at any time:

    target_T_source(t) = product of the edges between both, each interpolated at t

Translations are interpolated linearly, rotations by normalised linear interpolation of quaternions. Edges hold beyond
their ends for `HOLD`, and over gaps of `LONGEST_GAP`; farther away they are unknown.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from data_tools.datasets.mcap.objects import (
    OBJECT_TYPES,
    MessageObjects,
    ObjectType,
    checked_time,
    frame_name,
    message_objects,
    nanoseconds,
    wxyz,
    xyz,
)
from data_tools.datasets.mcap.recording import LoggedMessage, Recording, Topic, decoded_messages
from data_tools.files.isolated_reading import isolated
from saga_fg.errors import InputError, error_context, unknown_name
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, checked
from saga_fg.numerics.geometry import checked_quaternions, inverse_transform, quaternion_rotation
from saga_fg.types.dataset import Scene
from saga_fg.types.frame import Frame

log = logging.getLogger(__name__)

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

    def moves_in(self, frame: str) -> str | None:
        """The nearest frame above that `frame` moves in; None if it stands still in all."""
        upwards = self._upwards(frame)
        moving = (parent for child, parent in pairwise(upwards) if not self._edges[child].static)
        return next(moving, None)

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
        """ancestor_T_frame of the frame that the chain up begins at."""
        T, known = np.tile(np.eye(4), (len(time), 1, 1)), np.ones(len(time), dtype=bool)
        for child, _ in pairwise(upwards[: upwards.index(ancestor) + 1]):
            parent_T_child, there = self._edges[child].at(time)
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
    if logged.topic.type in ODOMETRY_TYPES:
        head, pose = message.header, message.pose.pose
        child = frame_name(message.child_frame_id) or DEFAULT_EGO
        edges = [(head.stamp, head.frame_id, child, pose.position, pose.orientation)]
    elif logged.topic.type == "tf2_msgs/TFMessage":
        edges = [
            (each.header.stamp, each.header.frame_id, each.child_frame_id, T.translation, T.rotation)
            for each, T in ((each, each.transform) for each in message.transforms)
        ]
    else:
        edges = [
            (each.timestamp, each.parent_frame_id, each.child_frame_id, each.translation, each.rotation)
            for each in getattr(message, "transforms", [message])
        ]
    static = logged.topic.name.endswith("tf_static")
    for stamp, parent, child, translation, rotation in edges:
        time = nanoseconds(stamp) or checked_time(logged.log_time)
        places = xyz(translation), wxyz(rotation)
        yield TransformRecord(frame_name(parent), frame_name(child), static, time, *places, where)


@dataclass(frozen=True)
class RecordingOptions:
    """Options for reading a recording.

    topics    topic by the sensor's name; empty: the one topic of objects that there is
    classes   name to take for a class that is there, "" to leave it out
    world     frame to track in; None: the topmost above the vehicle
    ego       frame of the vehicle
    odometry  topic of `nav_msgs/Odometry` for the pose; None: the transforms, and where there are none, the only topic
    """

    topics: Mapping[str, str] = field(default_factory=dict)
    classes: Mapping[str, str] = field(default_factory=dict)
    world: str | None = None
    ego: str = DEFAULT_EGO
    odometry: str | None = None


@dataclass(frozen=True, eq=False)
class RecordedScene(Scene):
    """The scene of a recording; world: name of the frame that is tracked in."""

    world: str = field(kw_only=True)


class McapRecording:
    """The one scene of a recording, named for its file or folder; it is read when asked for.

    Raises `InputError` for topics that are not there or hold no objects, with those that do.
    """

    def __init__(self, path: str | Path, options: RecordingOptions | None = None) -> None:
        self.options = options or RecordingOptions()
        self._recording = Recording(path)
        self.scenes = (self._recording.name,)
        with error_context(str(self._recording.path)):
            self.sensors = self._chosen()

    @property
    def files(self) -> tuple[Path, ...]:
        """The files of the recording."""
        return tuple(self._recording.files)

    @property
    def form(self) -> ObjectType:
        """The type of message for results: that of the first sensor."""
        topic = next(iter(self.sensors.values()))
        return OBJECT_TYPES[self._recording.topics[topic].type]

    def scene(self, name: str) -> RecordedScene:
        """Read the recording. Raises `InputError` naming file, topic, message and field; and for another name.

        Messages at times of which the pose is unknown are left out; a warning says how many.
        """
        if name not in self.scenes:
            raise InputError(f"{self._recording.path}: {unknown_name('scene', name, self.scenes)}")
        sensor_of = {topic: sensor for sensor, topic in self.sensors.items()}
        poses = self._pose_topics()
        seen: list[tuple[LoggedMessage, MessageObjects]] = []
        records: list[TransformRecord] = []
        for logged in recorded_messages(self._recording, [*sensor_of, *poses]):
            if logged.topic.name in sensor_of:
                with error_context(f"{self._recording.path}: {logged.topic.name}: message {logged.number}"):
                    seen.append((replace(logged, message=None), message_objects(logged.message, self.options.classes)))
            else:
                records += logged.message
        with error_context(str(self._recording.path)):
            if not seen:
                raise InputError(f"expected messages of {', '.join(sensor_of)}, there are none")
            places = self._placed(seen, TransformTree(records))
            frames = _frames(seen, sensor_of, places)
            times, first = np.unique([frame.timestamp for frame in frames], return_index=True)
            moments = [frames[k] for k in first.tolist()]
            world_T_ego = [np.eye(4) if frame.world_T_ego is None else frame.world_T_ego for frame in moments]
            tokens = tuple(frame.token for frame in moments)
            return RecordedScene(name, times, np.array(world_T_ego), tokens, frames, world=places.world)

    def _placed(self, seen: list[tuple[LoggedMessage, MessageObjects]], tree: TransformTree) -> _Places:
        """Poses of the vehicle and of the frames of the messages, at the times of the messages."""
        time: IntArray = np.array([objects.stamp for _, objects in seen], dtype=np.int64)
        used = list(dict.fromkeys(objects.frame for _, objects in seen if objects.frame))
        for child, parents in tree.contested.items():
            log.warning("%s: frame %s has several parents: %s", self._recording.path, child, ", ".join(parents))
        if not len(tree):
            if len(used) > 1:
                raise InputError(f"expected transforms (/tf) between the frames {', '.join(used)}, there are none")
            world = self.options.world or (used or ["world"])[0]
            log.warning(
                "%s: no transforms (/tf) and no odometry: frame %s is taken for one that stands still",
                self._recording.path,
                world,
            )
            return _Places(world, None, np.ones(len(time), dtype=bool), {})
        for frame in (*used, *([self.options.world] if self.options.world else [])):
            if frame not in tree.frames:
                message = next(
                    (f"{m.topic.name}: message {m.number}: " for m, o in seen if o.frame == frame), "--world: "
                )
                raise InputError(f"{message}{unknown_name('frame', frame, tree.frames)}")
        ego = self.options.ego if self.options.ego in tree.frames else None
        if ego is None and self.options.ego != DEFAULT_EGO:
            raise InputError(f"--ego: {unknown_name('frame', self.options.ego, tree.frames)}")
        world = self.options.world or tree.root(ego or used[0])
        for frame in (*used, *([ego] if ego else [])):
            if not tree.connected(world, frame):
                raise InputError(f"expected transforms between the frames {world} and {frame}, there are none")
        world_T_ego, known = tree.lookup(world, ego, time) if ego else (None, np.ones(len(time), dtype=bool))
        base = ego or world
        places = {frame: tree.lookup(base, frame, time) for frame in used if frame != world}
        for k, (_, objects) in enumerate(seen):
            if objects.frame in places:
                known[k] &= places[objects.frame][1][k]
        if not known.all():
            if not known.any():
                raise InputError(
                    f"expected transforms between {world} and {base} at the times of the messages, there are none"
                )
            log.warning(
                "%s: left out %d of %d messages, at whose times the transforms between %s and %s are unknown",
                self._recording.path,
                int((~known).sum()),
                len(known),
                world,
                " and ".join(dict.fromkeys([base, *places])),
            )
        return _Places(world, world_T_ego, known, {frame: T for frame, (T, _) in places.items()})

    def _chosen(self) -> dict[str, str]:
        """Topic by sensor."""
        topics = self._recording.topics
        fit = [each for each in topics.values() if each.type in OBJECT_TYPES]
        there = "; ".join(f"{each.name} ({each.type}, {each.count} messages)" for each in fit) or "none"
        if not self.options.topics:
            filled = [each for each in fit if each.count]
            if len(filled) != 1:
                raise InputError(
                    f"expected --topic with one or several of the topics that hold objects: {there}{self._others(fit)}"
                )
            log.info("%s: topic %s", self._recording.path, filled[0].name)
            return {filled[0].name.lstrip("/"): filled[0].name}
        for name in self.options.topics.values():
            if name not in topics:
                known = tuple(sorted(each.name for each in fit)) or tuple(sorted(topics))
                raise InputError(f"--topic: {unknown_name('topic', name, known)}")
            if topics[name].type not in OBJECT_TYPES:
                raise InputError(f"--topic {name}: {topics[name].type}: expected a topic that holds objects: {there}")
        return dict(self.options.topics)

    def _others(self, fit: Iterable[object]) -> str:
        """Topics of other types, where none fits."""
        if list(fit):
            return ""
        others = [f"{each.name} ({each.type})" for each in self._recording.topics.values()]
        more = f", ... ({len(others)} in all)" if len(others) > 12 else ""
        return f"; types that do: {', '.join(OBJECT_TYPES)}; there are {', '.join(others[:12]) or 'no topics'}{more}"

    def _pose_topics(self) -> list[str]:
        """Topics of transforms, and of odometry where it is asked for or there is nothing else."""
        topics = [each for each in self._recording.topics.values() if each.count]
        transforms = [each.name for each in topics if each.type in TRANSFORM_TYPES]
        odometry = [each.name for each in topics if each.type in ODOMETRY_TYPES]
        path, wanted = self._recording.path, self.options.odometry
        if wanted is not None:
            if wanted not in odometry:
                raise InputError(f"{path}: --odometry: {unknown_name('topic', wanted, tuple(odometry))}")
            return [*transforms, wanted]
        moving = [name for name in transforms if not name.endswith("tf_static")]
        if moving or not odometry:
            return transforms
        if len(odometry) > 1:
            raise InputError(f"{path}: expected --odometry with one of {', '.join(odometry)}, since there is no /tf")
        return [*transforms, odometry[0]]


@dataclass(frozen=True, eq=False)
class _Places:
    """world_T_ego (N, 4, 4) at the N messages, None without a vehicle; which are known; base_T_frame by frame, the
    base being the vehicle, or the world without one.
    """

    world: str
    world_T_ego: FloatArray | None
    known: BoolArray
    base_T_frame: Mapping[str, FloatArray]


def _frames(
    seen: list[tuple[LoggedMessage, MessageObjects]], sensor_of: Mapping[str, str], places: _Places
) -> list[Frame]:
    """The messages whose place is known as frames, in order of time."""
    frames = []
    for k in np.argsort([objects.stamp for _, objects in seen], kind="stable").tolist():
        logged, objects = seen[k]
        if not places.known[k]:
            continue
        pose = None if places.world_T_ego is None else places.world_T_ego[k]
        detections, base_T_frame = objects.detections, places.base_T_frame.get(objects.frame)
        if base_T_frame is not None:
            detections = detections.transformed(base_T_frame[k])
        in_ego = base_T_frame is not None and pose is not None
        with error_context(f"{logged.topic.name}: message {logged.number}"):
            sensor, token = sensor_of[logged.topic.name], str(objects.stamp)
            frames.append(Frame(objects.stamp / 1e9, sensor, detections, pose, "ego" if in_ego else "world", token))
    return frames

"""A recording as a dataset of one scene: the objects of its topics, each topic a sensor, and the pose of the vehicle.

Objects are brought from the frame of their message to the vehicle's by the transforms at the time of the message; the
moments of the scene are these times. The tokens of the moments are the times in ns, as the messages have them.
"""

import logging
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.datasets.mcap.objects import OBJECT_TYPES, MessageObjects, ObjectType, message_objects
from data_tools.datasets.mcap.recording import LoggedMessage, Recording, Topic, decoded_messages
from data_tools.datasets.mcap.ros2_types import checked_time
from data_tools.datasets.mcap.transforms import (
    DEFAULT_EGO,
    ODOMETRY_TYPES,
    TRANSFORM_TYPES,
    Places,
    TransformRecord,
    TransformTree,
    check_frame,
    find_places,
    transform_records,
)
from data_tools.files import isolated
from saga_fg.errors import InputError, error_context, unknown_name
from saga_fg.numerics import IntArray
from saga_fg.types import Frame, Scene

log = logging.getLogger(__name__)


def recorded_messages(recording: Recording, topics: Collection[str]) -> Iterator[LoggedMessage]:
    """The messages of some topics, in the order of the files, read in a child process.

    Each has its `ObjectRows`, with a stamp, or a list of its `TransformRecord`s as the message. Raises `InputError`
    naming file, topic, message and field.
    """
    return isolated("not readable", _contents, recording.path, recording.files, recording.chosen(topics))


def _contents(path: Path, files: Sequence[Path], topics: Mapping[str, Topic]) -> Iterator[LoggedMessage]:
    for logged in decoded_messages(files, topics):
        with error_context(f"{path}: {logged.topic.name}: message {logged.number}"):
            content = message_content(logged)
        yield replace(logged, message=content)


def message_content(logged: LoggedMessage) -> Any:
    """Return the `ObjectRows` of a message, with a stamp, or its transforms.

    Raises `InputError` for a field that its definition lacks, and for a time that is none.
    """
    try:
        if logged.topic.type not in OBJECT_TYPES:
            return list(transform_records(logged))
        rows = OBJECT_TYPES[logged.topic.type].rows(logged.message)
    except AttributeError as error:
        raise InputError(
            f"{error.name}: expected this field in {logged.topic.type}, its definition here has none"
        ) from error
    rows.stamp = rows.stamp or checked_time(logged.log_time)
    return rows


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

    @property
    def names(self) -> dict[str, str]:
        """The name in the recording of each class of ours."""
        return {ours: theirs for theirs, ours in reversed(list(self.classes.items()))}


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
            frames = placed_frames(seen, sensor_of, places)
            times, first = np.unique([frame.timestamp for frame in frames], return_index=True)
            moments = [frames[k] for k in first.tolist()]
            world_T_ego = [np.eye(4) if frame.world_T_ego is None else frame.world_T_ego for frame in moments]
            tokens = tuple(frame.token for frame in moments)
            return RecordedScene(name, times, np.array(world_T_ego), tokens, frames, world=places.world)

    def _placed(self, seen: list[tuple[LoggedMessage, MessageObjects]], tree: TransformTree) -> Places:
        """Poses of the vehicle and of the frames of the messages, at the times of the messages."""
        time: IntArray = np.array([objects.stamp for _, objects in seen], dtype=np.int64)
        used = list(dict.fromkeys(objects.frame for _, objects in seen if objects.frame))
        for child, parents in tree.contested.items():
            log.warning("%s: frame %s has several parents: %s", self._recording.path, child, ", ".join(parents))
        if not len(tree):
            if len(used) > 1:
                raise InputError(f"expected transforms (/tf) between the frames {', '.join(used)}, there are none")
            world = self.options.world or (used or ["world"])[0]
            text = "%s: no transforms (/tf), no --odometry: frame %s is taken for one that stands still (or --world)"
            log.warning(text, self._recording.path, world)
            return Places(world, None, np.ones(len(time), dtype=bool), {})
        first = {objects.frame: f"{m.topic.name}: message {m.number}" for m, objects in reversed(seen)}
        for frame in (*used, *([self.options.world] if self.options.world else [])):
            with error_context(first.get(frame, "--world")):
                check_frame(tree, frame)
        ego = self.options.ego if self.options.ego in tree.frames else None
        if ego is None and self.options.ego != DEFAULT_EGO:
            with error_context("--ego"):
                check_frame(tree, self.options.ego)
        world = self.options.world or tree.root(ego or used[0])
        places = find_places(tree, world, ego, [objects.frame for _, objects in seen], time)
        known, base = places.known, ego or world
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
                " and ".join(dict.fromkeys([base, *places.base_T_frame])),
            )
        return places

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


def placed_frames(
    seen: Sequence[tuple[LoggedMessage, MessageObjects]], sensor_of: Mapping[str, str], places: Places
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

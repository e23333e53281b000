"""The types of messages that hold objects, those that hold poses, and what is taken from them."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, cast

from data_tools.datasets.mcap import autoware, scene_update, vision
from data_tools.datasets.mcap.objects import MessageType, frame_name, nanoseconds, wxyz, xyz
from data_tools.datasets.mcap.recording import LoggedMessage, Recording, Topic, decoded_messages
from data_tools.datasets.mcap.transforms import TransformRecord
from data_tools.files.error_messages import error_context
from data_tools.files.isolated_reading import isolated
from saga_fg.errors import InputError

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
                    content.stamp = content.stamp or logged.log_time
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
    return nanoseconds(stamp) or logged.log_time

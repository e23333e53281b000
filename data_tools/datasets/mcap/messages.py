"""The types of messages that hold objects, and those that hold poses."""

from __future__ import annotations

from collections.abc import Iterator
from types import ModuleType
from typing import Any, cast

from data_tools.datasets.mcap import autoware, scene_update, vision
from data_tools.datasets.mcap.objects import MessageType, frame_name, nanoseconds, wxyz, xyz
from data_tools.datasets.mcap.recording import LoggedMessage
from data_tools.datasets.mcap.transforms import TransformRecord

MODULES: tuple[ModuleType, ...] = (autoware, vision, scene_update)
OBJECT_TYPES: dict[str, MessageType] = {name: cast(MessageType, module) for module in MODULES for name in module.TYPES}
TRANSFORM_TYPES = ("tf2_msgs/TFMessage", "foxglove.FrameTransforms", "foxglove.FrameTransform")
ODOMETRY_TYPES = ("nav_msgs/Odometry",)
DEFAULT_EGO = "base_link"


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

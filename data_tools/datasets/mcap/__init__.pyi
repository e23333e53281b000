from .dataset import RecordingOptions, message_content, placed_frames
from .objects import OBJECT_TYPES, RESULTS, MessageObjects, message_objects
from .recording import SUFFIXES, LoggedMessage, Recording, Topic, decoded_messages
from .ros2_types import checked_time, decoder, encoded, fields_of, frame_name, nanoseconds, plain_type, xyz
from .source import sensor_topics
from .transforms import (
    DEFAULT_EGO,
    HOLD,
    ODOMETRY_TYPES,
    TRANSFORM_TYPES,
    WORLD,
    TransformBuffer,
    TransformRecord,
    TransformTree,
    find_places,
    transform_records,
)

__all__ = [
    "DEFAULT_EGO",
    "HOLD",
    "OBJECT_TYPES",
    "ODOMETRY_TYPES",
    "RESULTS",
    "SUFFIXES",
    "TRANSFORM_TYPES",
    "WORLD",
    "LoggedMessage",
    "MessageObjects",
    "Recording",
    "RecordingOptions",
    "Topic",
    "TransformBuffer",
    "TransformRecord",
    "TransformTree",
    "checked_time",
    "decoded_messages",
    "decoder",
    "encoded",
    "fields_of",
    "find_places",
    "frame_name",
    "message_content",
    "message_objects",
    "nanoseconds",
    "placed_frames",
    "plain_type",
    "sensor_topics",
    "transform_records",
    "xyz",
]

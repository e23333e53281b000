"""Types of ROS 2: their definitions in the text form of their packages, small parts, and messages in CDR by arrays.

    std_msgs/Header header            a type and the name of a field on each line
    Object[] objects

Messages are written in CDR (XCDR version 1, little-endian): every number stands at a multiple of its size, counted from
the end of the four bytes of the header; a text and a sequence begin with their length. The numbers of many objects are
written at once: where a field of an object stands depends on its texts and on where the object begins, modulo 8.

Sources: the packages std_msgs, geometry_msgs, nav_msgs, sensor_msgs, visualization_msgs (Humble and later), tf2_msgs
(ros2/common_interfaces, ros2/geometry2), vision_msgs 4, autoware_perception_msgs (autowarefoundation/autoware_msgs);
OMG, DDS Interoperability Wire Protocol 2.5, section 10.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from saga_fg.errors import InputError
from saga_fg.numerics import IntArray

Message = dict[str, Any]

_SEPARATOR = "=" * 80
_FIELDS = {
    "builtin_interfaces/Time": "int32 sec, uint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp, string frame_id",
    "unique_identifier_msgs/UUID": "uint8[16] uuid",
    "geometry_msgs/Point": "float64 x, float64 y, float64 z",
    "geometry_msgs/Point32": "float32 x, float32 y, float32 z",
    "geometry_msgs/Vector3": "float64 x, float64 y, float64 z",
    "geometry_msgs/Quaternion": "float64 x, float64 y, float64 z, float64 w",
    "geometry_msgs/Pose": "geometry_msgs/Point position, geometry_msgs/Quaternion orientation",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear, geometry_msgs/Vector3 angular",
    "geometry_msgs/Accel": "geometry_msgs/Vector3 linear, geometry_msgs/Vector3 angular",
    "geometry_msgs/Polygon": "geometry_msgs/Point32[] points",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose, float64[36] covariance",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist, float64[36] covariance",
    "geometry_msgs/AccelWithCovariance": "geometry_msgs/Accel accel, float64[36] covariance",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation, geometry_msgs/Quaternion rotation",
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header, string child_frame_id, geometry_msgs/Transform transform"
    ),
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "nav_msgs/Odometry": (
        "std_msgs/Header header, string child_frame_id, geometry_msgs/PoseWithCovariance pose, "
        "geometry_msgs/TwistWithCovariance twist"
    ),
    "sensor_msgs/PointField": "string name, uint32 offset, uint8 datatype, uint32 count",
    "sensor_msgs/PointCloud2": (
        "std_msgs/Header header, uint32 height, uint32 width, sensor_msgs/PointField[] fields, bool is_bigendian, "
        "uint32 point_step, uint32 row_step, uint8[] data, bool is_dense"
    ),
    "sensor_msgs/LaserScan": (
        "std_msgs/Header header, float32 angle_min, float32 angle_max, float32 angle_increment, "
        "float32 time_increment, float32 scan_time, float32 range_min, float32 range_max, float32[] ranges, "
        "float32[] intensities"
    ),
    "sensor_msgs/Imu": (
        "std_msgs/Header header, geometry_msgs/Quaternion orientation, float64[9] orientation_covariance, "
        "geometry_msgs/Vector3 angular_velocity, float64[9] angular_velocity_covariance, "
        "geometry_msgs/Vector3 linear_acceleration, float64[9] linear_acceleration_covariance"
    ),
    "sensor_msgs/NavSatStatus": "int8 status, uint16 service",
    "sensor_msgs/NavSatFix": (
        "std_msgs/Header header, sensor_msgs/NavSatStatus status, float64 latitude, float64 longitude, "
        "float64 altitude, float64[9] position_covariance, uint8 position_covariance_type"
    ),
    "std_msgs/ColorRGBA": "float32 r, float32 g, float32 b, float32 a",
    "builtin_interfaces/Duration": "int32 sec, uint32 nanosec",
    "sensor_msgs/CompressedImage": "std_msgs/Header header, string format, uint8[] data",
    "visualization_msgs/UVCoordinate": "float32 u, float32 v",
    "visualization_msgs/MeshFile": "string filename, uint8[] data",
    "visualization_msgs/Marker": (
        "std_msgs/Header header, string ns, int32 id, int32 type, int32 action, geometry_msgs/Pose pose, "
        "geometry_msgs/Vector3 scale, std_msgs/ColorRGBA color, builtin_interfaces/Duration lifetime, "
        "bool frame_locked, geometry_msgs/Point[] points, std_msgs/ColorRGBA[] colors, string texture_resource, "
        "sensor_msgs/CompressedImage texture, visualization_msgs/UVCoordinate[] uv_coordinates, string text, "
        "string mesh_resource, visualization_msgs/MeshFile mesh_file, bool mesh_use_embedded_materials"
    ),
    "visualization_msgs/MarkerArray": "visualization_msgs/Marker[] markers",
    "vision_msgs/BoundingBox3D": "geometry_msgs/Pose center, geometry_msgs/Vector3 size",
    "vision_msgs/ObjectHypothesis": "string class_id, float64 score",
    "vision_msgs/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis, geometry_msgs/PoseWithCovariance pose"
    ),
    "vision_msgs/Detection3D": (
        "std_msgs/Header header, vision_msgs/ObjectHypothesisWithPose[] results, vision_msgs/BoundingBox3D bbox, "
        "string id"
    ),
    "vision_msgs/Detection3DArray": "std_msgs/Header header, vision_msgs/Detection3D[] detections",
    "autoware_perception_msgs/ObjectClassification": "uint8 label, float32 probability",
    "autoware_perception_msgs/Shape": ("uint8 type, geometry_msgs/Polygon footprint, geometry_msgs/Vector3 dimensions"),
    "autoware_perception_msgs/DetectedObjectKinematics": (
        "geometry_msgs/PoseWithCovariance pose_with_covariance, bool has_position_covariance, "
        "uint8 orientation_availability, geometry_msgs/TwistWithCovariance twist_with_covariance, bool has_twist, "
        "bool has_twist_covariance"
    ),
    "autoware_perception_msgs/DetectedObject": (
        "float32 existence_probability, autoware_perception_msgs/ObjectClassification[] classification, "
        "autoware_perception_msgs/DetectedObjectKinematics kinematics, autoware_perception_msgs/Shape shape"
    ),
    "autoware_perception_msgs/DetectedObjects": (
        "std_msgs/Header header, autoware_perception_msgs/DetectedObject[] objects"
    ),
    "autoware_perception_msgs/TrackedObjectKinematics": (
        "geometry_msgs/PoseWithCovariance pose_with_covariance, "
        "geometry_msgs/TwistWithCovariance twist_with_covariance, "
        "geometry_msgs/AccelWithCovariance acceleration_with_covariance, uint8 orientation_availability, "
        "bool is_stationary"
    ),
    "autoware_perception_msgs/TrackedObject": (
        "unique_identifier_msgs/UUID object_id, float32 existence_probability, "
        "autoware_perception_msgs/ObjectClassification[] classification, "
        "autoware_perception_msgs/TrackedObjectKinematics kinematics, autoware_perception_msgs/Shape shape"
    ),
    "autoware_perception_msgs/TrackedObjects": (
        "std_msgs/Header header, autoware_perception_msgs/TrackedObject[] objects"
    ),
}
NUMBERS = {
    "bool": np.dtype("?"),
    "uint8": np.dtype("u1"),
    "int8": np.dtype("i1"),
    "uint16": np.dtype("<u2"),
    "int32": np.dtype("<i4"),
    "uint32": np.dtype("<u4"),
    "float32": np.dtype("<f4"),
    "float64": np.dtype("<f8"),
}
"""NumPy's type of each type of numbers."""
_HEADER = b"\x00\x01\x00\x00"  # CDR, little-endian
_WORD = 8  # bytes of the largest number


class Field(NamedTuple):
    """A field of a type; length: None for one value, 0 for a sequence, else that of an array."""

    name: str
    type: str
    length: int | None


@cache
def fields_of(type_: str) -> tuple[Field, ...]:
    """Return the fields of a type that is known here, in the order of its definition."""
    found = (re.fullmatch(r"([\w/]+)(?:\[(\d*)])? (\w+)", field.strip()) for field in _FIELDS[type_].split(","))
    parts = (each.groups() for each in found if each is not None)
    return tuple(Field(name, kind, None if length is None else int(length or 0)) for kind, length, name in parts)


_FORMER = {"autoware_auto_perception_msgs": "autoware_perception_msgs"}  # the package's name until 2023


def plain_type(name: str) -> str:
    """Name of a message's type without `/msg`, and with the present name of its package."""
    package, _, message = name.replace("/msg/", "/").partition("/")
    return f"{_FORMER.get(package, package)}/{message}" if message else package


def definition(name: str) -> str | None:
    """Definition of a type with those it is made of, as MCAP holds it; None for a type that is not known here."""
    name = plain_type(name)
    if name not in _FIELDS:
        return None
    needed = [name]
    for each in needed:  # grows on the way
        needed += [field.type for field in fields_of(each) if field.type in _FIELDS and field.type not in needed]
    texts = ["\n".join(field.strip() for field in _FIELDS[each].split(",")) for each in needed]
    parts = [f"MSG: {each}\n{text}" if k else text for k, (each, text) in enumerate(zip(needed, texts, strict=True))]
    return f"\n{_SEPARATOR}\n".join(parts) + "\n"


@dataclass(frozen=True)
class Columns:
    """The messages of a sequence: by field an array (number, ...), a list of texts, or what is the same in all."""

    number: int
    fields: Mapping[str, Any]


def encoded(type_: str, message: Mapping[str, Any]) -> bytes:
    """Return a message in CDR; sequences of messages in it are `Columns`, or lists of few that all objects share.

    Raises `KeyError` where a field is missing.
    """
    body = bytearray()
    _append(body, plain_type(type_), Columns(1, message))
    return _HEADER + bytes(body)


class _Sequence(NamedTuple):
    type: str
    columns: Columns


_Leaf = NDArray[Any] | list[bytes]  # numbers (N, k), or texts


def _append(body: bytearray, type_: str, messages: Columns) -> None:
    leaves: list[_Leaf] = []
    for leaf in _leaves(type_, messages.fields, messages.number):
        if isinstance(leaf, _Sequence):
            _place(body, leaves, messages.number)
            leaves = []
            _append(body, leaf.type, leaf.columns)
        else:
            leaves.append(leaf)
    _place(body, leaves, messages.number)


def _leaves(type_: str, values: Mapping[str, Any], n: int) -> Iterator[_Leaf | _Sequence]:
    """Numbers and texts of n messages in their order in CDR."""
    for name, kind, length in fields_of(type_):
        value = values[name]
        if length == 0:
            count = value.number if isinstance(value, Columns) else len(value)
            yield np.full((n, 1), count, dtype=NUMBERS["uint32"])
        if isinstance(value, Columns):
            yield _Sequence(kind, value)
        elif kind == "string":
            texts = [value] * n if isinstance(value, str) else value
            encodings = [text.encode() + b"\0" for text in texts]
            yield np.array([[len(each)] for each in encodings], dtype=NUMBERS["uint32"]).reshape(n, 1)
            yield encodings
        elif kind in NUMBERS:
            width = 1 if length is None else length or len(value)
            if width:
                yield np.broadcast_to(np.asarray(value, dtype=NUMBERS[kind]).reshape(-1, width), (n, width))
        else:
            for each in [value] if length is None else value:
                yield from _leaves(kind, each, n)


def _place(body: bytearray, leaves: list[_Leaf], n: int) -> None:
    """Append n messages, one after the other."""
    end: IntArray = np.repeat(np.arange(_WORD)[:, None], n, axis=1)  # by where a message begins, modulo 8
    begins: list[IntArray] = []
    for leaf in leaves:
        if isinstance(leaf, list):
            begins.append(end)
            end = end + np.array([len(text) for text in leaf], dtype=np.int64)
        else:
            begins.append(-(-end // leaf.itemsize) * leaf.itemsize)
            end = begins[-1] + leaf.shape[1] * leaf.itemsize
    word = len(body) // _WORD * _WORD  # from here places are counted
    phase, at = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    position = len(body) - word
    for k in range(n):
        phase[k] = position % _WORD
        at[k] = position - phase[k]
        position = int(at[k] + end[phase[k], k])
    room = np.zeros(-(-position // _WORD) * _WORD, dtype=np.uint8)
    for leaf, begin in zip(leaves, begins, strict=True):
        places = at + begin[phase, np.arange(n)]
        if isinstance(leaf, list):
            for place, text in zip(places.tolist(), leaf, strict=True):
                room[place : place + len(text)] = np.frombuffer(text, dtype=np.uint8)
        else:
            room.view(leaf.dtype)[places[:, None] // leaf.itemsize + np.arange(leaf.shape[1])] = leaf
    body += room[len(body) - word : position].tobytes()


def nanoseconds(stamp: Any) -> int:
    """ns of a ROS time (sec, nanosec)."""
    return checked_time(int(stamp.sec) * 10**9 + int(stamp.nanosec))


def checked_time(time: int) -> int:
    """A time, ns, that 64 bits hold. Raises `InputError` for another."""
    if not -(2**63) <= time < 2**63:
        raise InputError(f"time: expected nanoseconds within 64 bits, got {time}")
    return time


def frame_name(name: str) -> str:
    """Name of a frame without the leading slash of old."""
    return name.lstrip("/")


def xyz(vector: Any) -> tuple[float, float, float]:
    """Components of a vector."""
    return (vector.x, vector.y, vector.z)


def wxyz(quaternion: Any) -> tuple[float, float, float, float]:
    """Components of a quaternion, the scalar first."""
    return (quaternion.w, quaternion.x, quaternion.y, quaternion.z)


def header(stamp: int, frame: str) -> Message:
    """A std_msgs/Header; stamp in ns."""
    seconds, nanoseconds = divmod(stamp, 10**9)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame}

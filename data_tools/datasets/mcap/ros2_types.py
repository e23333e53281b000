"""Messages of ROS 2 by rosbags: types that are known here, CDR, and small parts.

Types are named without `/msg`. Known are those of ROS 2 Humble (rosbags), and those of vision_msgs and Autoware, whose
fields stand here, "type name" each.

Sources: vision_msgs 4 (https://github.com/ros-perception/vision_msgs), autoware_perception_msgs
(https://github.com/autowarefoundation/autoware_msgs).
"""

from collections.abc import Callable, Iterable, Iterator
from functools import cache, partial
from typing import Any

from saga_fg.errors import InputError

_OTHERS = {
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
    "autoware_perception_msgs/Shape": "uint8 type, geometry_msgs/Polygon footprint, geometry_msgs/Vector3 dimensions",
    "autoware_perception_msgs/DetectedObjectKinematics": (
        "geometry_msgs/PoseWithCovariance pose_with_covariance, bool has_position_covariance, uint8 "
        "orientation_availability, geometry_msgs/TwistWithCovariance twist_with_covariance, bool has_twist, bool "
        "has_twist_covariance"
    ),
    "autoware_perception_msgs/DetectedObject": (
        "float32 existence_probability, autoware_perception_msgs/ObjectClassification[] classification, "
        "autoware_perception_msgs/DetectedObjectKinematics kinematics, autoware_perception_msgs/Shape shape"
    ),
    "autoware_perception_msgs/DetectedObjects": (
        "std_msgs/Header header, autoware_perception_msgs/DetectedObject[] objects"
    ),
    "autoware_perception_msgs/TrackedObjectKinematics": (
        "geometry_msgs/PoseWithCovariance pose_with_covariance, geometry_msgs/TwistWithCovariance "
        "twist_with_covariance, geometry_msgs/AccelWithCovariance acceleration_with_covariance, uint8 "
        "orientation_availability, bool is_stationary"
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
"""Fields of the types that rosbags does not have."""
_FORMER = {"autoware_auto_perception_msgs": "autoware_perception_msgs"}  # the package's name until 2023


def plain_type(name: str) -> str:
    """Name of a message's type without `/msg`, and with the present name of its package."""
    package, _, message = name.replace("/msg/", "/").partition("/")
    return f"{_FORMER.get(package, package)}/{message}" if message else package


def _full(type_: str) -> str:
    """The name of a type as rosbags has it."""
    return type_.replace("/", "/msg/")


@cache
def known_types() -> Any:
    """The types that are known here, a `Typestore` of rosbags."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    parsed = [get_types_from_msg(fields.replace(", ", "\n"), _full(name)) for name, fields in _OTHERS.items()]
    store.register({name: fields for types in parsed for name, fields in types.items()})
    return store


def ros_message(type_: str, *values: Any) -> Any:
    """A message of a known type, of the values of its fields in their order."""
    return known_types().types[_full(type_)](*values)


def definition(name: str) -> str | None:
    """Definition of a type with those it is made of, as MCAP holds it; None for a type that is not known here."""
    known = _full(plain_type(name))
    return known_types().generate_msgdef(known, ros_version=2)[0] if known in known_types().types else None


def fields_of(type_: str) -> Iterator[tuple[str, str, int | None]]:
    """Name and type of each field of a known type; length: None for one value, 0 for a sequence, else of an array."""
    for name, (_, kind) in known_types().fielddefs[_full(type_)][1]:
        many = isinstance(kind[0], tuple)
        of = kind[0][1] if many else kind
        yield name, plain_type(of if isinstance(of, str) else of[0]), kind[1] if many else None


MAX_FIXED = 1000  # entries that are no numbers, of an array of fixed length: rosbags makes code of each


def decoder(type_: str, text: str | None = None) -> Callable[[bytes], Any]:
    """The function that decodes messages of a type by this definition (None: the known one); it raises what it will.

    Raises `InputError` for a definition with an array of more than `MAX_FIXED` texts or messages.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    name = _full(plain_type(type_))
    if text is None:
        store = known_types()
    else:
        store = get_typestore(Stores.EMPTY)
        types = get_types_from_msg(text.replace("\r\n", "\n"), name)
        for _, fields in types.values():
            _check_lengths(fields)
        store.register(types)
    return partial(store.deserialize_cdr, typename=name)


def _check_lengths(fields: Iterable[tuple[str, Any]]) -> None:
    for name, (_, kind) in fields:
        if isinstance(kind[0], tuple) and kind[1] > MAX_FIXED:
            of = kind[0][1] if isinstance(kind[0][1], str) else kind[0][1][0]
            if of in ("string", "wstring") or "/" in of:
                raise InputError(f"{name}: expected a fixed length of at most {MAX_FIXED} of {of}, got {kind[1]}")


def encoded(type_: str, message: Any) -> bytes:
    """A message of a known type in CDR."""
    return bytes(known_types().serialize_cdr(message, _full(type_)))


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


def header(stamp: int, frame: str) -> Any:
    """A std_msgs/Header; stamp in ns."""
    return ros_message("std_msgs/Header", ros_message("builtin_interfaces/Time", *divmod(stamp, 10**9)), frame)

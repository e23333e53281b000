"""Definitions of ROS 2 messages in the text form of their packages: for bags that hold none, and for results.

    std_msgs/Header header            a type and the name of a field on each line
    Object[] objects

Source: the packages std_msgs, geometry_msgs, nav_msgs, tf2_msgs (ros2/common_interfaces, ros2/geometry2), vision_msgs
4, autoware_perception_msgs (autowarefoundation/autoware_msgs).
"""

from __future__ import annotations

import re

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
        used = (re.sub(r"\[.*", "", field.split()[0]) for field in _FIELDS[each].split(","))
        needed += [type_ for type_ in used if type_ in _FIELDS and type_ not in needed]
    texts = ["\n".join(field.strip() for field in _FIELDS[each].split(",")) for each in needed]
    parts = [f"MSG: {each}\n{text}" if k else text for k, (each, text) in enumerate(zip(needed, texts, strict=True))]
    return f"\n{_SEPARATOR}\n".join(parts) + "\n"

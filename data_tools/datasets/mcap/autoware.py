"""Autoware's objects: `autoware_perception_msgs/DetectedObjects` and `TrackedObjects`.

Poses are in the frame of the header, velocities over ground along the axes of the object, as Autoware has them. The
score is the existence probability, the class the most probable one. Results are `TrackedObjects`; their ids are those
of the tracks, in the last eight bytes.

Source: https://github.com/autowarefoundation/autoware_msgs; Autoware documentation, "Object recognition".
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from data_tools.datasets.mcap import objects as ros
from data_tools.datasets.mcap.objects import NO_COVARIANCE, ObjectRows, frame_name, nanoseconds, wxyz, xyz
from saga_fg.types.track import Tracks

TYPES = ("autoware_perception_msgs/DetectedObjects", "autoware_perception_msgs/TrackedObjects")
RESULT = "autoware_perception_msgs/TrackedObjects"
CLASSES = (
    *("unknown", "car", "truck", "bus", "trailer", "motorcycle", "bicycle", "pedestrian", "animal", "hazard"),
    *("over_drivable", "under_drivable"),
)  # by the number of ObjectClassification
_UNAVAILABLE, _AVAILABLE = 0, 2  # orientation
_CYLINDER, _POLYGON = 1, 2  # shape
_POSE, _TWIST = "objects[{}].kinematics.pose_with_covariance.", "objects[{}].kinematics.twist_with_covariance."
FIELDS = {
    "position": _POSE + "pose.position",
    "rotation": _POSE + "pose.orientation",
    "covariance": _POSE + "covariance",
    "size": "objects[{}].shape.dimensions",
    "score": "objects[{}].existence_probability",
    "velocity": _TWIST + "twist.linear",
    "velocity_covariance": _TWIST + "covariance",
}


def rows(message: Any) -> ObjectRows:
    """The objects of a message; detected ones say what is known of their motion."""
    found = ObjectRows(nanoseconds(message.header.stamp), frame_name(message.header.frame_id), FIELDS, in_body=True)
    for each in message.objects:
        motion, shape = each.kinematics, each.shape
        pose, twist = motion.pose_with_covariance, motion.twist_with_covariance
        detected = hasattr(motion, "has_twist")
        with_twist = motion.has_twist if detected else True
        surest = max(each.classification, key=lambda c: c.probability, default=None)
        found.label.append(_class_name(surest.label if surest is not None else 0))
        found.score.append(each.existence_probability)
        found.id.append(str(int.from_bytes(bytes(each.object_id.uuid)[-8:])) if hasattr(each, "object_id") else "")
        found.position.append(xyz(pose.pose.position))
        found.rotation.append(wxyz(pose.pose.orientation))
        found.heading.append(motion.orientation_availability != _UNAVAILABLE)
        found.size.append(_size(shape))
        found.velocity.append(xyz(twist.twist.linear) if with_twist else NO_COVARIANCE[:3])
        known = motion.has_position_covariance if detected else True
        found.covariance.append(pose.covariance if known else NO_COVARIANCE)
        known = motion.has_twist_covariance if detected else True
        found.velocity_covariance.append(twist.covariance if known else NO_COVARIANCE)
    return found


def result(tracks: Tracks, stamp: int, frame: str, names: Mapping[str, str]) -> ros.Fields:
    """`TrackedObjects` of tracks; a class that Autoware does not have is unknown."""
    boxes, velocity, spread = tracks.boxes, _in_body(tracks), _velocity_covariance_in_body(tracks)
    objects = [
        {
            "object_id": {"uuid": list(int(id_).to_bytes(16))},
            "existence_probability": float(np.clip(score, 0, 1)),
            "classification": [{"label": _class_number(names.get(label, label)), "probability": 1.0}],
            "kinematics": {
                "pose_with_covariance": {
                    "pose": ros.pose(boxes.position[k], boxes.yaw[k]),
                    "covariance": ros.covariance(tracks.position_covariance[k]),
                },
                "twist_with_covariance": {
                    "twist": {"linear": ros.vector(velocity[k]), "angular": ros.vector(np.zeros(3))},
                    "covariance": ros.covariance(spread[k]),
                },
                "acceleration_with_covariance": {
                    "accel": {"linear": ros.vector(np.zeros(3)), "angular": ros.vector(np.zeros(3))},
                    "covariance": [0.0] * 36,
                },
                "orientation_availability": _AVAILABLE if np.isfinite(boxes.yaw[k]) else _UNAVAILABLE,
                "is_stationary": False,
            },
            "shape": {"type": 0, "footprint": {"points": []}, "dimensions": ros.vector(boxes.size[k])},
        }
        for k, (id_, label, score) in enumerate(
            zip(tracks.id.tolist(), boxes.label.tolist(), tracks.score.tolist(), strict=True)
        )
    ]
    return {"header": ros.header(stamp, frame), "objects": objects}


def _size(shape: Any) -> tuple[float, float, float]:
    """Length, width and height; of a polygon those of its footprint, if it has no dimensions."""
    x, y, z = xyz(shape.dimensions)
    if shape.type == _CYLINDER:
        return x, x, z
    points = shape.footprint.points
    if shape.type == _POLYGON and points and not (x > 0 and y > 0):
        across = [[getattr(point, axis) for point in points] for axis in "xy"]
        x, y = (max(values) - min(values) for values in across)
    return x, y, z


def _class_name(number: int) -> str:
    return CLASSES[number] if number < len(CLASSES) else str(number)


def _class_number(name: str) -> int:
    if name in CLASSES:
        return CLASSES.index(name)
    return int(name) if name.isdecimal() and int(name) < 256 else 0


def _axes(tracks: Tracks) -> Any:
    """Rotations (N, 2, 2) from the axes of the boxes to those of the frame."""
    yaw = np.nan_to_num(tracks.boxes.yaw)
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)


def _in_body(tracks: Tracks) -> Any:
    flat = np.einsum("nji,nj->ni", _axes(tracks), tracks.boxes.velocity)
    return np.column_stack([flat, np.zeros(len(flat))])


def _velocity_covariance_in_body(tracks: Tracks) -> Any:
    R = _axes(tracks)
    return np.swapaxes(R, 1, 2) @ tracks.velocity_covariance @ R

"""Objects of messages: raw rows of two families of types, checked field by field, and tracks as messages of each.

`autoware_perception_msgs/DetectedObjects` and `TrackedObjects`. Poses are in the frame of the header, velocities over
ground along the axes of the object, as Autoware has them. The score is the existence probability, the class the most
probable one. Results are `TrackedObjects`; their ids are those of the tracks, in the last eight bytes. Source:
https://github.com/autowarefoundation/autoware_msgs; Autoware documentation, "Object recognition".

`vision_msgs/Detection3DArray`: boxes with hypotheses of classes, of which the one of highest score counts. Results are
of the same type; `id` is that of the track. There is no place for a velocity. Source:
https://github.com/ros-perception/vision_msgs, version 4 (Humble and later).

`visualization_msgs/MarkerArray`, of results alone: a box and a text for each track, for RViz.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from data_tools.datasets.mcap.ros2_types import frame_name, header, nanoseconds, ros_message, wxyz, xyz
from saga_fg.errors import InputError
from saga_fg.numerics import (
    FloatArray,
    StrArray,
    quaternion_norms,
    quaternion_rotation,
    refuse,
    yaw_of,
    yaw_quaternion,
)
from saga_fg.types import MAX_POSITION, MAX_SIZE, MAX_SPEED, Boxes, Detections, Tracks

NAN = float("nan")
NO_COVARIANCE = (NAN,) * 36


class ObjectRow(NamedTuple):
    """An object as its message has it: m, m/s, the scalar of a quaternion first.

    covariance           36 numbers of the pose, row by row, the first two rows and columns x and y; NaN: not given
    velocity_covariance  likewise of the velocity
    heading              whether the rotation is known
    """

    id: str
    label: str
    score: float
    position: tuple[float, float, float]
    rotation: tuple[float, float, float, float]
    size: tuple[float, float, float]
    velocity: tuple[float, float, float] = (NAN, NAN, NAN)
    covariance: Any = NO_COVARIANCE
    velocity_covariance: Any = NO_COVARIANCE
    heading: bool = True


@dataclass
class ObjectRows:
    """The objects of one message, as they are there.

    stamp    ns; 0: not given
    frame    name of the coordinate frame
    fields   the place in the message of each field of `ObjectRow`, with {} for the number of the object
    in_body  whether velocities are along the axes of the boxes
    """

    stamp: int
    frame: str
    fields: Mapping[str, str]
    in_body: bool = False
    objects: list[ObjectRow] = field(default_factory=list)

    def fault(self, name: str, row: int, what: str) -> InputError:
        """An error about a field of an object."""
        return InputError(f"{self.fields[name].format(row)}: {what}")


class ObjectType(NamedTuple):
    """A type of message with objects.

    result   type of results
    rows     the objects of a message; raises `AttributeError` where a field is missing
    message  a message of tracks, with its time, ns, the name of its frame, and the names of classes in the recording
    """

    result: str
    rows: Callable[[Any], ObjectRows]
    message: Callable[[Tracks, int, str, Mapping[str, str]], Any]


@dataclass(frozen=True, eq=False)
class MessageObjects:
    """N objects of a message: detections, their ids (N,), covariances (N, 2, 2) of the velocities (NaN: unknown)."""

    stamp: int
    frame: str
    detections: Detections
    id: StrArray
    velocity_covariance: FloatArray


def message_objects(rows: ObjectRows, classes: Mapping[str, str]) -> MessageObjects:
    """The objects of a message; classes: the name to take for one that is there, "" to leave it out.

    Sizes of 0, rotations of norm 0 and covariances of 0 are unknown. Raises `InputError` naming the field.
    """
    position = _numbers(rows, "position", 3, MAX_POSITION)
    size = _numbers(rows, "size", 3, MAX_SIZE, unknown=True)
    refuse(
        (size < 0).any(axis=1),
        lambda row: rows.fault("size", row, f"expected sizes >= 0 in m, got {rows.objects[row].size}"),
    )
    score = _numbers(rows, "score", 0, np.inf)
    rotation = _numbers(rows, "rotation", 4, np.inf)
    norm = quaternion_norms(rotation)
    turned = norm > 0
    refuse(
        turned & (np.abs(norm - 1) > 1e-2),
        lambda row: rows.fault("rotation", row, f"expected a unit quaternion, got norm {norm[row]:.4g}"),
    )
    unit = np.where(turned[:, None], rotation, [1.0, 0, 0, 0]) / np.where(turned, norm, 1.0)[:, None]
    R = quaternion_rotation(unit)
    velocity = _numbers(rows, "velocity", 3, MAX_SPEED, unknown=True)
    covariance, spread = _covariances(rows, "covariance"), _covariances(rows, "velocity_covariance")
    if rows.in_body and rows.objects:
        velocity = np.einsum("nij,nj->ni", R, velocity)
        spread = R[:, :2, :2] @ spread @ np.swapaxes(R[:, :2, :2], 1, 2)
    yaw = np.where(turned & np.array([each.heading for each in rows.objects], dtype=bool), yaw_of(R), np.nan)
    label = [classes.get(each.label, each.label or "object") for each in rows.objects]
    kept = np.flatnonzero([name != "" for name in label])
    label = [name or "object" for name in label]
    boxes = Boxes.of(label, position, np.where(size > 0, size, np.nan), yaw, velocity[:, :2])
    detections = Detections(boxes, score, position_covariance=covariance)
    id_ = np.array([each.id for each in rows.objects], dtype=np.str_)
    return MessageObjects(rows.stamp, rows.frame, detections.select(kept), id_[kept], spread[kept])


def _numbers(rows: ObjectRows, name: str, width: int, limit: float, unknown: bool = False) -> FloatArray:
    """A column (N, width), or (N,) for width 0, of numbers within a limit; NaN only where it may be unknown."""
    values = [getattr(each, name) for each in rows.objects]
    array = np.array(values, dtype=np.float64).reshape((len(values), width) if width else len(values))
    bad = ~(np.abs(array) <= limit) if np.isfinite(limit) else ~np.isfinite(array)
    if unknown:
        bad &= ~np.isnan(array)
    refuse(
        bad.reshape(len(values), max(width, 1)).any(axis=1),
        lambda row: rows.fault(name, row, f"expected finite numbers, got {values[row]}"),
    )
    return array


def _covariances(rows: ObjectRows, name: str) -> FloatArray:
    """The horizontal part (N, 2, 2) of 6 x 6 covariances, NaN where zero. Raises `InputError` for an invalid one."""
    values = [getattr(each, name) for each in rows.objects]
    P = np.array([(v[0], v[1], v[6], v[7]) for v in values], dtype=np.float64).reshape(-1, 2, 2)
    P = np.where((P == 0).all(axis=(1, 2), keepdims=True), np.nan, P)
    P = (P + np.swapaxes(P, 1, 2)) / 2
    given = ~np.isnan(P).all(axis=(1, 2))
    valid = (
        (P[:, 0, 0] > 0) & (P[:, 1, 1] > 0) & (P[:, 0, 0] * P[:, 1, 1] > P[:, 0, 1] ** 2) & np.isfinite(P).all((1, 2))
    )
    expected = "expected a positive definite covariance of x and y"
    refuse(
        given & ~valid,
        lambda row: rows.fault(name, row, f"{expected}, got {P[row].round(6).tolist()}"),
    )
    return P


def vectors(values: FloatArray, kind: str = "Vector3") -> list[Any]:
    """geometry_msgs/Vector3s, or Points, of rows (N, 3); unknown entries are 0."""
    return [ros_message(f"geometry_msgs/{kind}", *row) for row in np.nan_to_num(values).tolist()]


def poses(position: FloatArray, yaw: FloatArray) -> list[Any]:
    """geometry_msgs/Poses of positions (N, 3) and headings (N,); an unknown one is 0."""
    turns = np.roll(yaw_quaternion(np.nan_to_num(yaw)), -1, axis=1).tolist()  # x y z w
    return [
        ros_message("geometry_msgs/Pose", point, ros_message("geometry_msgs/Quaternion", *turn))
        for point, turn in zip(vectors(position, "Point"), turns, strict=True)
    ]


def covariances(P: FloatArray) -> FloatArray:
    """The entries (N, 36) of covariances with a horizontal part (N, 2, 2) alone; unknown is 0."""
    whole = np.zeros((len(P), 6, 6))
    whole[:, :2, :2] = np.nan_to_num(P)
    return whole.reshape(-1, 36)


AUTOWARE_CLASSES = (
    *("unknown", "car", "truck", "bus", "trailer", "motorcycle", "bicycle", "pedestrian", "animal", "hazard"),
    *("over_drivable", "under_drivable"),
)  # by the number of ObjectClassification
_PACKAGE = "autoware_perception_msgs"
_UNAVAILABLE, _AVAILABLE = 0, 2  # orientation
_CYLINDER, _POLYGON = 1, 2  # shape
_POSE, _TWIST = "objects[{}].kinematics.pose_with_covariance.", "objects[{}].kinematics.twist_with_covariance."
_AUTOWARE_FIELDS = {
    "position": _POSE + "pose.position",
    "rotation": _POSE + "pose.orientation",
    "covariance": _POSE + "covariance",
    "size": "objects[{}].shape.dimensions",
    "score": "objects[{}].existence_probability",
    "velocity": _TWIST + "twist.linear",
    "velocity_covariance": _TWIST + "covariance",
}


def autoware_rows(message: Any) -> ObjectRows:
    """The objects of `DetectedObjects`, which say what is known of their motion, or of `TrackedObjects`."""
    stamp, frame = nanoseconds(message.header.stamp), frame_name(message.header.frame_id)
    found = ObjectRows(stamp, frame, _AUTOWARE_FIELDS, in_body=True)
    for each in message.objects:
        motion = each.kinematics
        pose, twist = motion.pose_with_covariance, motion.twist_with_covariance
        surest = max(each.classification, key=lambda c: c.probability, default=None)
        number = surest.label if surest is not None else 0
        found.objects.append(
            ObjectRow(
                id=str(int.from_bytes(bytes(each.object_id.uuid)[-8:])) if hasattr(each, "object_id") else "",
                label=AUTOWARE_CLASSES[number] if number < len(AUTOWARE_CLASSES) else str(number),
                score=each.existence_probability,
                position=xyz(pose.pose.position),
                rotation=wxyz(pose.pose.orientation),
                size=_autoware_size(each.shape),
                velocity=xyz(twist.twist.linear) if getattr(motion, "has_twist", True) else (NAN, NAN, NAN),
                covariance=pose.covariance if getattr(motion, "has_position_covariance", True) else NO_COVARIANCE,
                velocity_covariance=twist.covariance
                if getattr(motion, "has_twist_covariance", True)
                else NO_COVARIANCE,
                heading=motion.orientation_availability != _UNAVAILABLE,
            )
        )
    return found


def autoware_message(tracks: Tracks, stamp: int, frame: str, names: Mapping[str, str]) -> Any:
    """`TrackedObjects` of tracks; a class that Autoware does not have is unknown."""
    boxes, yaw = tracks.boxes, np.nan_to_num(tracks.boxes.yaw)
    c, s = np.cos(yaw), np.sin(yaw)
    frame_T_body = np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)
    flat = np.einsum("nji,nj->ni", frame_T_body, boxes.velocity)
    spread = np.swapaxes(frame_T_body, 1, 2) @ tracks.velocity_covariance @ frame_T_body
    motions = zip(
        poses(boxes.position, boxes.yaw),
        covariances(tracks.position_covariance),
        vectors(np.column_stack([flat, np.zeros(len(flat))])),
        covariances(spread),
        np.where(np.isfinite(boxes.yaw), _AVAILABLE, _UNAVAILABLE).tolist(),
        strict=True,
    )
    objects = [
        ros_message(
            f"{_PACKAGE}/TrackedObject",
            ros_message("unique_identifier_msgs/UUID", np.frombuffer(id_.to_bytes(16), dtype=np.uint8)),
            score,
            [ros_message(f"{_PACKAGE}/ObjectClassification", _class_number(names.get(label, label)), 1.0)],
            _autoware_motion(*motion),
            ros_message(f"{_PACKAGE}/Shape", 0, ros_message("geometry_msgs/Polygon", []), size),
        )
        for id_, score, label, motion, size in zip(
            tracks.id.tolist(),
            np.clip(tracks.score, 0, 1).tolist(),
            boxes.label.tolist(),
            motions,
            vectors(boxes.size),
            strict=True,
        )
    ]
    return ros_message(f"{_PACKAGE}/TrackedObjects", header(stamp, frame), objects)


def _autoware_motion(pose: Any, covariance: FloatArray, velocity: Any, spread: FloatArray, orientation: int) -> Any:
    """`TrackedObjectKinematics` without turn rate and acceleration."""
    still, nothing = ros_message("geometry_msgs/Vector3", 0.0, 0.0, 0.0), np.zeros(36)
    twist, rest = ros_message("geometry_msgs/Twist", velocity, still), ros_message("geometry_msgs/Accel", still, still)
    return ros_message(
        f"{_PACKAGE}/TrackedObjectKinematics",
        ros_message("geometry_msgs/PoseWithCovariance", pose, covariance),
        ros_message("geometry_msgs/TwistWithCovariance", twist, spread),
        ros_message("geometry_msgs/AccelWithCovariance", rest, nothing),
        orientation,
        False,
    )


def _autoware_size(shape: Any) -> tuple[float, float, float]:
    """Length, width and height; of a polygon those of its footprint, if it has no dimensions."""
    x, y, z = xyz(shape.dimensions)
    if shape.type == _CYLINDER:
        return x, x, z
    points = shape.footprint.points
    if shape.type == _POLYGON and points and not (x > 0 and y > 0):
        across = [[getattr(point, axis) for point in points] for axis in "xy"]
        x, y = (max(values) - min(values) for values in across)
    return x, y, z


def _class_number(name: str) -> int:
    if name in AUTOWARE_CLASSES:
        return AUTOWARE_CLASSES.index(name)
    return int(name) if name.isdecimal() and len(name) < 4 and int(name) < 256 else 0


_VISION_FIELDS = {
    "position": "detections[{}].bbox.center.position",
    "rotation": "detections[{}].bbox.center.orientation",
    "covariance": "detections[{}].results[].pose.covariance",
    "size": "detections[{}].bbox.size",
    "score": "detections[{}].results[].hypothesis.score",
}


def _vision_rows(message: Any) -> ObjectRows:
    found = ObjectRows(nanoseconds(message.header.stamp), frame_name(message.header.frame_id), _VISION_FIELDS)
    for each in message.detections:
        surest = max(each.results, key=lambda result: result.hypothesis.score, default=None)
        label, score = ("", 1.0) if surest is None else (surest.hypothesis.class_id, surest.hypothesis.score)
        place = each.bbox.center
        row = ObjectRow(each.id, label, score, xyz(place.position), wxyz(place.orientation), xyz(each.bbox.size))
        found.objects.append(row if surest is None else row._replace(covariance=surest.pose.covariance))
    return found


def _vision_message(tracks: Tracks, stamp: int, frame: str, names: Mapping[str, str]) -> Any:
    boxes, head = tracks.boxes, header(stamp, frame)
    columns = zip(
        tracks.id.tolist(),
        boxes.label.tolist(),
        tracks.score.tolist(),
        poses(boxes.position, boxes.yaw),
        covariances(tracks.position_covariance),
        vectors(boxes.size),
        strict=True,
    )
    detections = []
    for id_, label, score, pose, spread, size in columns:
        hypothesis = ros_message("vision_msgs/ObjectHypothesis", names.get(label, label), score)
        place = ros_message("geometry_msgs/PoseWithCovariance", pose, spread)
        results = [ros_message("vision_msgs/ObjectHypothesisWithPose", hypothesis, place)]
        box = ros_message("vision_msgs/BoundingBox3D", pose, size)
        detections.append(ros_message("vision_msgs/Detection3D", head, results, box, str(id_)))
    return ros_message("vision_msgs/Detection3DArray", head, detections)


_COLOUR = (0.1, 0.45, 0.9)
_TEXT_GAP = 0.4  # m above the box
_UNKNOWN_SIZE = 0.5  # m
_CUBE, _TEXT, _DELETE_ALL, _MARKERS = 1, 9, 3, "saga_fg"  # types and action of markers, their namespace


def _marker_message(tracks: Tracks, stamp: int, frame: str, names: Mapping[str, str]) -> Any:
    """A box and a text for each track; the first marker removes those before."""
    boxes, n, head = tracks.boxes, len(tracks), header(stamp, frame)
    size = np.where(np.isfinite(boxes.size), boxes.size, _UNKNOWN_SIZE)
    above = boxes.position + size * [0, 0, 0.5] + [0, 0, _TEXT_GAP]
    place = np.concatenate([np.zeros((1, 3)), boxes.position, above])
    texts = [f"{names.get(label, label)} {id_}" for label, id_ in zip(boxes.label, tracks.id.tolist(), strict=True)]
    columns = zip(
        [_MARKERS] + n * [_MARKERS] + n * [f"{_MARKERS} names"],
        range(1 + 2 * n),
        [_CUBE] + n * [_CUBE] + n * [_TEXT],
        [_DELETE_ALL] + 2 * n * [0],
        poses(place, np.concatenate([[0.0], boxes.yaw, np.zeros(n)])),
        vectors(np.concatenate([np.zeros((1, 3)), size, np.ones((n, 3))])),
        [0.0] + n * [0.5] + n * [1.0],
        ["", *n * [""], *texts],
        strict=True,
    )
    lifetime, nothing = ros_message("builtin_interfaces/Duration", 1, 0), np.zeros(0, dtype=np.uint8)
    texture = ros_message("sensor_msgs/CompressedImage", header(0, ""), "", nothing)
    mesh = ros_message("visualization_msgs/MeshFile", "", nothing)
    markers = []
    look: tuple[Any, ...]
    for *about, opacity, text in columns:
        look = ros_message("std_msgs/ColorRGBA", *_COLOUR, opacity), lifetime, False, [], [], "", texture, []
        markers.append(ros_message("visualization_msgs/Marker", head, *about, *look, text, "", mesh, False))
    return ros_message("visualization_msgs/MarkerArray", markers)


_AUTOWARE = ObjectType(f"{_PACKAGE}/TrackedObjects", autoware_rows, autoware_message)
_VISION = ObjectType("vision_msgs/Detection3DArray", _vision_rows, _vision_message)
OBJECT_TYPES = {
    f"{_PACKAGE}/DetectedObjects": _AUTOWARE,
    f"{_PACKAGE}/TrackedObjects": _AUTOWARE,
    "vision_msgs/Detection3DArray": _VISION,
}
RESULTS = {
    **{each.result: each.message for each in (_AUTOWARE, _VISION)},
    "visualization_msgs/MarkerArray": _marker_message,
}
"""The message of tracks of each type of results."""

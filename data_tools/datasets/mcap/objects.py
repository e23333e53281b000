"""Objects of a message, whatever its type, as checked rows and back.

Objects of a message, whatever its type: raw rows, checked field by field, and as detections.

A type of message is a module with the functions of `MessageType`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, StrArray
from saga_fg.numerics.geometry import checked_quaternions, quaternion_norms, quaternion_rotation, yaw_of, yaw_quaternion
from saga_fg.types.boxes import MAX_POSITION, MAX_SIZE, MAX_SPEED, Boxes
from saga_fg.types.frame import Detections
from saga_fg.types.track import Tracks

NAN = float("nan")
NO_COVARIANCE = (NAN,) * 36


@dataclass
class ObjectRows:
    """Columns of the objects of one message, as they are there.

    stamp                ns; 0: not given
    frame                name of the coordinate frame
    velocity             (vx, vy, vz), m/s; in_body: whether along the axes of the box
    covariance           36 numbers of the pose, row by row, the first two rows and columns x and y; NaN: not given
    velocity_covariance  likewise of the velocity
    heading              whether the rotation is known
    """

    stamp: int
    frame: str
    fields: Mapping[str, str]
    in_body: bool = False
    id: list[str] = field(default_factory=list)
    label: list[str] = field(default_factory=list)
    score: list[float] = field(default_factory=list)
    position: list[tuple[float, float, float]] = field(default_factory=list)
    rotation: list[tuple[float, float, float, float]] = field(default_factory=list)
    heading: list[bool] = field(default_factory=list)
    size: list[tuple[float, float, float]] = field(default_factory=list)
    velocity: list[tuple[float, float, float]] = field(default_factory=list)
    covariance: list[Any] = field(default_factory=list)
    velocity_covariance: list[Any] = field(default_factory=list)


class MessageType(Protocol):
    """A type of message with objects: how it is read, and how tracks are written in its like.

    RESULT   type of the results; in ROS 2's encoding if it has a definition, in protobuf else
    """

    TYPES: tuple[str, ...]
    RESULT: str

    @staticmethod
    def rows(message: Any) -> ObjectRows:
        """The objects of a message; raises `AttributeError` where a field is missing."""

    @staticmethod
    def result(tracks: Tracks, stamp: int, frame: str, names: Mapping[str, str]) -> Any:
        """A message of tracks; names: of classes, in the terms of the recording."""


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
    n = len(rows.label)
    position = _numbers(rows, "position", rows.position, 3, MAX_POSITION)
    size = _numbers(rows, "size", rows.size, 3, MAX_SIZE, unknown=True)
    if (size < 0).any():
        row = int(np.argmax((size < 0).any(axis=1)))
        raise InputError(f"{rows.fields['size'].format(row)}: expected sizes >= 0 in m, got {rows.size[row]}")
    score = _numbers(rows, "score", rows.score, 0, np.inf)
    rotation = _numbers(rows, "rotation", rows.rotation, 4, np.inf)
    norm = quaternion_norms(rotation)
    turned = norm > 0
    bad = turned & (np.abs(norm - 1) > 1e-2)
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(f"{rows.fields['rotation'].format(row)}: expected a unit quaternion, got norm {norm[row]:.4g}")
    unit = np.where(turned[:, None], rotation, [1.0, 0, 0, 0]) / np.where(turned, norm, 1.0)[:, None]
    R = quaternion_rotation(unit)
    velocity = _numbers(rows, "velocity", rows.velocity, 3, MAX_SPEED, unknown=True)
    covariance = _covariances(rows, "covariance", rows.covariance)
    spread = _covariances(rows, "velocity_covariance", rows.velocity_covariance)
    if rows.in_body and n:
        velocity = np.einsum("nij,nj->ni", R, velocity)
        spread = R[:, :2, :2] @ spread @ np.swapaxes(R[:, :2, :2], 1, 2)
    yaw = np.where(turned & np.array(rows.heading, dtype=bool), yaw_of(R), np.nan)
    label = [classes.get(name, name or "object") for name in rows.label]
    kept = np.flatnonzero([name != "" for name in label])
    label = [name or "object" for name in label]
    boxes = Boxes.of(label, position, np.where(size > 0, size, np.nan), yaw, velocity[:, :2])
    detections = Detections(boxes, score, position_covariance=covariance)
    id_ = np.array(rows.id, dtype=np.str_)
    return MessageObjects(rows.stamp, rows.frame, detections.select(kept), id_[kept], spread[kept])


def _numbers(
    rows: ObjectRows, name: str, values: list[Any], width: int, limit: float, unknown: bool = False
) -> FloatArray:
    """A column (N, width), or (N,) for width 0, of numbers within a limit; NaN only where it may be unknown."""
    array = np.array(values, dtype=np.float64).reshape((len(values), width) if width else len(values))
    bad = ~(np.abs(array) <= limit) if np.isfinite(limit) else ~np.isfinite(array)
    if unknown:
        bad &= ~np.isnan(array)
    if bad.any():
        row = int(np.argwhere(bad)[0][0])
        raise InputError(f"{rows.fields[name].format(row)}: expected finite numbers, got {values[row]}")
    return array


def _covariances(rows: ObjectRows, name: str, values: list[Any]) -> FloatArray:
    """The horizontal part (N, 2, 2) of 6 x 6 covariances, NaN where zero. Raises `InputError` for an invalid one."""
    P = np.array([(v[0], v[1], v[6], v[7]) for v in values], dtype=np.float64).reshape(-1, 2, 2)
    P = np.where((P == 0).all(axis=(1, 2), keepdims=True), np.nan, P)
    P = (P + np.swapaxes(P, 1, 2)) / 2
    given = ~np.isnan(P).all(axis=(1, 2))
    valid = (
        (P[:, 0, 0] > 0) & (P[:, 1, 1] > 0) & (P[:, 0, 0] * P[:, 1, 1] > P[:, 0, 1] ** 2) & np.isfinite(P).all((1, 2))
    )
    if (given & ~valid).any():
        row = int(np.argmax(given & ~valid))
        got = [[float(f"{entry:.4g}") for entry in line] for line in P[row].tolist()]
        raise InputError(
            f"{rows.fields[name].format(row)}: expected a positive definite covariance of x and y, got {got}"
        )
    return P


def transform_matrix(transform: Any) -> FloatArray:
    """The matrix (4, 4) of a geometry_msgs/Transform. Raises `InputError` for an invalid rotation."""
    T = np.eye(4)
    T[:3, :3] = quaternion_rotation(checked_quaternions("rotation", [wxyz(transform.rotation)]))[0]
    T[:3, 3] = xyz(transform.translation)
    return T


def nanoseconds(stamp: Any) -> int:
    """ns of a ROS time (sec, nanosec) or a protobuf timestamp (seconds, nanos)."""
    if hasattr(stamp, "seconds"):
        return checked_time(int(stamp.seconds) * 10**9 + int(stamp.nanos))
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


Fields = dict[str, Any]


def header(stamp: int, frame: str) -> Fields:
    """A std_msgs/Header; stamp in ns."""
    seconds, nanoseconds = divmod(stamp, 10**9)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame}


def vector(values: FloatArray) -> Fields:
    """A vector or point (3,); unknown entries are 0."""
    x, y, z = np.nan_to_num(values).tolist()
    return {"x": x, "y": y, "z": z}


def pose(position: FloatArray, yaw: float) -> Fields:
    """A geometry_msgs/Pose; an unknown yaw is 0."""
    w, x, y, z = yaw_quaternion(float(np.nan_to_num(yaw))).tolist()
    return {"position": vector(position), "orientation": {"x": x, "y": y, "z": z, "w": w}}


def covariance(P: FloatArray) -> list[float]:
    """36 entries of a 6 x 6 covariance with a horizontal part (2, 2) alone; unknown is 0."""
    whole = np.zeros((6, 6))
    whole[:2, :2] = np.nan_to_num(P)
    return whole.ravel().tolist()

"""Everything the sensors said in a recording, as one table: what offline smoothing attributes to objects.

A recording has moments t_0 < t_1 < ...: the times of all its frames and all times at which boxes are wanted. A row of
the table is a usable detection (see `saga_fg.tracking.measurements`), with the sensor's model of its noise; a look is a
frame, empty or not, which tells where something could have been detected.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.tracking.measurements import frame_measurements
from saga_fg.tracking.settings import ClassSettings
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Frame
from saga_fg.types.sensor import Sensor, sensor_model


@dataclass(frozen=True, eq=False)
class Look:
    """One frame: the moment it belongs to, the sensor's model, and the pose of the vehicle, (4, 4) or None."""

    moment: int
    sensor: Sensor
    world_T_ego: FloatArray | None


@dataclass(frozen=True, eq=False)
class Evidence:
    """N usable detections of a recording, in order of time, positions from a local `origin`.

    times        (K,) s, of all moments
    looks        L frames in order of time
    origin       (2,) world coordinates of the local origin
    look         (N,) which look
    boxes                     positions local in the plane
    probability  (N,)
    R            (N, 4, 4)    of position and velocity
    with_velocity (N,)        whether the velocity was measured
    z_noise, yaw_noise (N,)   standard deviations, m and rad
    distance     (N,)         from the vehicle, m; NaN where its place is unknown
    """

    times: FloatArray
    looks: tuple[Look, ...]
    origin: FloatArray
    look: IntArray
    boxes: Boxes
    probability: FloatArray
    R: FloatArray
    with_velocity: BoolArray
    z_noise: FloatArray
    yaw_noise: FloatArray
    distance: FloatArray

    def __len__(self) -> int:
        return len(self.boxes)

    @property
    def moment(self) -> IntArray:
        """(N,) the moment of each detection."""
        moments = np.array([look.moment for look in self.looks], dtype=np.int64)
        return moments[self.look] if len(self) else np.empty(0, dtype=np.int64)

    def rows_of_look(self) -> list[slice]:
        """The rows of each look."""
        bounds = np.searchsorted(self.look, np.arange(len(self.looks) + 1)).tolist()
        return [slice(a, b) for a, b in pairwise(bounds)]


def gather_evidence(
    frames: Sequence[Frame],
    wanted: FloatArray,
    sensors: Mapping[str, Sensor],
    classes: Mapping[str, ClassSettings],
) -> Evidence:
    """The table of a recording's frames, in order of measurement.

    wanted (M,): times at which boxes are wanted, s
    """
    ordered = measured_in_order(frames, sensors)
    stamps = np.array([time for time, _ in ordered])
    times = np.unique(np.concatenate([wanted, stamps]))
    origin = _origin(frames)
    looks, parts = [], []
    for time, frame in ordered:
        sensor = sensor_model(sensors, frame.sensor)
        looks.append(Look(int(np.searchsorted(times, time)), sensor, frame.world_T_ego))
        parts.append(frame_measurements(frame, sensor, classes))
    boxes = Boxes.concatenate([part.boxes for part in parts])
    counts = [len(part) for part in parts]
    places = [
        np.full((len(part), 2), np.nan)
        if look.world_T_ego is None
        else np.tile(look.world_T_ego[:2, 3], (len(part), 1))
        for look, part in zip(looks, parts, strict=True)
    ]
    place = np.concatenate([np.empty((0, 2)), *places])
    distance = np.hypot(*(boxes.position[:, :2] - place).T)
    return Evidence(
        times,
        tuple(looks),
        origin,
        np.repeat(np.arange(len(parts)), counts),
        replace(boxes, position=boxes.position - [*origin, 0.0]),
        np.concatenate([np.empty(0), *(part.probability for part in parts)]),
        np.concatenate([np.empty((0, 4, 4)), *(part.R for part in parts)]),
        np.concatenate([np.empty(0, dtype=np.bool_), *(part.with_velocity for part in parts)]),
        np.concatenate([np.empty(0), *(part.z_noise for part in parts)]),
        np.concatenate([np.empty(0), *(part.yaw_noise for part in parts)]),
        distance,
    )


def measured_in_order(frames: Sequence[Frame], sensors: Mapping[str, Sensor]) -> list[tuple[float, Frame]]:
    """The frames with their times of measurement (s), in that order: offline, no frame is late."""
    timed = [(frame.timestamp + sensor_model(sensors, frame.sensor).time_offset, frame) for frame in frames]
    return sorted(timed, key=lambda pair: pair[0])


def _origin(frames: Sequence[Frame]) -> FloatArray:
    """(2,) a place near what was detected, in whole metres: global coordinates would eat the digits."""
    for frame in frames:
        if frame.world_T_ego is not None:
            return np.asarray(np.round(frame.world_T_ego[:2, 3]))
        if len(frame):
            return np.asarray(np.round(frame.detections.boxes.position[0, :2]))
    return np.zeros(2)

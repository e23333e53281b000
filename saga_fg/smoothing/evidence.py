r"""Everything that sensors measured in a recording, as one table, and the score of an object by its evidence.

A recording has moments t_0 < t_1 < ...: the times of all its frames and all times at which boxes are wanted. A row of
the table is a usable detection (see `saga_fg.tracking.measurements`), with the sensor's model of its noise; a frame,
empty or not, is an opportunity to detect what is in its field of view.

    score = sum_k p_k / (opportunities + prior)

p_k the probabilities of an object's detections, opportunities the frames that had it in view during its life: the
posterior mean of its hit ratio, with the detector's probabilities in place of yes and no, from a Beta prior that counts
as `prior` opportunities without a detection. A lone detection scores low, however probable, and a long track scores its
mean.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from saga_fg.model.sensor import Sensor, sensor_model
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.smoothing.states import Lifespans, StateTable
from saga_fg.tracking.measurements import frame_measurements
from saga_fg.tracking.settings import ClassSettings
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Frame


@dataclass(frozen=True, eq=False)
class EvidenceFrame:
    """A frame: its moment, the sensor's model, and the pose of the vehicle, (4, 4) or None."""

    moment: int
    sensor: Sensor
    world_T_ego: FloatArray | None


@dataclass(frozen=True, eq=False)
class Evidence:
    """N usable detections of a recording, in order of time, positions from a local `origin`.

    times        (K,) s, of all moments
    frames       L frames in order of time
    origin       (2,) world coordinates of the local origin
    frame        (N,) which frame
    boxes                     positions local in the plane
    probability  (N,)
    R            (N, 4, 4)    of position and velocity
    with_velocity (N,)        whether the velocity was measured
    z_noise, yaw_noise (N,)   standard deviations, m and rad
    distance     (N,)         from the vehicle, m; NaN where its place is unknown
    """

    times: FloatArray
    frames: tuple[EvidenceFrame, ...]
    origin: FloatArray
    frame: IntArray
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
        moments = np.array([frame.moment for frame in self.frames], dtype=np.int64)
        return moments[self.frame] if len(self) else np.empty(0, dtype=np.int64)

    def rows_of_frame(self) -> list[slice]:
        """The rows of each frame."""
        bounds = np.searchsorted(self.frame, np.arange(len(self.frames) + 1)).tolist()
        return [slice(a, b) for a, b in pairwise(bounds)]


def gather_evidence(
    frames: Sequence[Frame],
    wanted: FloatArray,
    sensors: Mapping[str, Sensor],
    classes: Mapping[str, ClassSettings],
) -> Evidence:
    """Build the table of a recording's frames, in order of measurement.

    wanted (M,): times at which boxes are wanted, s
    """
    ordered = measured_in_order(frames, sensors)
    stamps = np.array([time for time, _ in ordered])
    times = np.unique(np.concatenate([wanted, stamps]))
    origin = _origin(frames)
    taken, parts = [], []
    for time, frame in ordered:
        sensor = sensor_model(sensors, frame.sensor)
        taken.append(EvidenceFrame(int(np.searchsorted(times, time)), sensor, frame.world_T_ego))
        parts.append(frame_measurements(frame, sensor, classes))
    boxes = Boxes.concatenate([part.boxes for part in parts])
    poses = [part.world_T_ego for part in parts]
    places = [np.full(2, np.nan) if pose is None else pose[:2, 3] for pose in poses]
    number = np.repeat(np.arange(len(parts)), [len(part) for part in parts])

    def column(name: str, *shape: int, dtype: type = float) -> Any:
        return np.concatenate([np.empty((0, *shape), dtype), *(getattr(part, name) for part in parts)])

    return Evidence(
        times,
        tuple(taken),
        origin,
        number,
        replace(boxes, position=boxes.position - [*origin, 0.0]),
        column("probability"),
        column("R", 4, 4),
        column("with_velocity", dtype=bool),
        column("z_noise"),
        column("yaw_noise"),
        np.hypot(*(boxes.position[:, :2] - np.reshape(places, (-1, 2))[number]).T),
    )


def measured_in_order(frames: Sequence[Frame], sensors: Mapping[str, Sensor]) -> list[tuple[float, Frame]]:
    """Sort frames by their times of measurement (s), which are returned with them: offline, no frame is late."""
    timed = [(frame.timestamp + sensor_model(sensors, frame.sensor).time_offset, frame) for frame in frames]
    return sorted(timed, key=lambda pair: pair[0])


def _origin(frames: Sequence[Frame]) -> FloatArray:
    """(2,) a place near the detections, in whole metres: world coordinates leave too few digits."""
    for frame in frames:
        if frame.world_T_ego is not None:
            return np.asarray(np.round(frame.world_T_ego[:2, 3]))
        if len(frame):
            return np.asarray(np.round(frame.detections.boxes.position[0, :2]))
    return np.zeros(2)


def evidence_scores(
    evidence: Evidence, object_of: IntArray, lifespans: Lifespans, states: StateTable, prior_opportunity_time: float
) -> FloatArray:
    """(n,) scores in [0, 1). prior_opportunity_time: of missed opportunities that every object starts with, s."""
    rows = np.flatnonzero(object_of >= 0)
    owner = lifespans.rows_of(object_of[rows])
    total = np.bincount(owner, evidence.probability[rows], minlength=len(lifespans))
    seen = np.bincount(owner, minlength=len(lifespans))
    count = np.maximum(opportunities(evidence, lifespans, states), seen)
    return np.asarray(total / (count + prior_opportunity_time * frame_rate(evidence)))


def opportunities(evidence: Evidence, lifespans: Lifespans, states: StateTable) -> IntArray:
    """(n,) number of frames with each object in their field of view."""
    count = np.zeros(len(lifespans), dtype=np.int64)
    for frame in evidence.frames:
        rows = states.at(frame.moment)
        position = states.mean[rows, :2] + evidence.origin
        count[lifespans.rows_of(states.id[rows])] += frame.sensor.sees(position, frame.world_T_ego)
    return count


def frame_rate(evidence: Evidence) -> float:
    """Frames per second, of all sensors."""
    moments = [frame.moment for frame in evidence.frames]
    if len(set(moments)) < 2:
        return 1.0
    return (len(moments) - 1) / float(evidence.times[moments[-1]] - evidence.times[moments[0]])

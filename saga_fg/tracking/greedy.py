"""The greedy nearest-centre tracker of CenterPoint (Yin, Zhou, Kraehenbuehl, CVPR 2021, section 4.2).

Detections, strongest first, take the nearest free track of their class, where tracks are projected by their velocity;
velocity comes from the detector or, where it measured none, from the difference of the last two positions. There is no
filter: a track is where its last detection was.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from saga_fg.errors import require_type
from saga_fg.model import Sensor, checked_sensors, sensor_model
from saga_fg.numerics import Columns, FloatArray, IntArray, StrArray, near_pairs
from saga_fg.settings import PositiveOrInf, Settings, setting, settings_group
from saga_fg.tracking.clock import MAX_JUMP, Clock, TimeVerdict
from saga_fg.tracking.clock_offsets import SensorTime, SharedObservations, sensor_times
from saga_fg.tracking.sensor_noise import SensorNoise
from saga_fg.types import DEFAULT, MAX_POSITION, MAX_SPEED, Boxes, Frame, Tracks, class_numbers

MAX_DELAY = 0.5  # s; older frames are left out
BASELINE = 0.2  # s, least time between two positions whose difference gives a velocity; shorter: noise
NOMINAL_VARIANCE = 1.0  # the method knows no covariance; Tracks need one, m^2 and (m/s)^2


@dataclass(frozen=True)
class GreedySettings(Settings):
    """The greedy nearest-centre tracker (Yin et al., CenterPoint, CVPR 2021, section 4.2)."""

    max_distance: Mapping[str, float] = settings_group(
        lambda: {DEFAULT: 4.0, "pedestrian": 1.0, "bicycle": 3.0, "motorcycle": 13.0},
        "largest distance of prediction and detection by class, m; default serves all others; usual 1 to "
        "12; higher: more matches, right and wrong",
    )
    max_coasting: PositiveOrInf = setting(
        1.2, "delete a track this long after its last detection, s; usual 1 to 6; higher: bridges longer occlusions"
    )


@dataclass(frozen=True, eq=False)
class _Memory(Columns):
    """n tracks at their latest detection, and the position and time from which their velocity is measured."""

    id: IntArray
    label: StrArray
    position: FloatArray
    size: FloatArray
    yaw: FloatArray
    velocity: FloatArray
    score: FloatArray
    last_seen: FloatArray
    anchor: FloatArray
    anchor_time: FloatArray


@dataclass(frozen=True, eq=False)
class GreedySnapshot:
    """A greedy tracker at one time: its tracks, the id of the next one, its clock, its verdict on the latest frame."""

    memory: _Memory
    next_id: int
    clock: Clock
    time_verdict: TimeVerdict


class GreedyTracker:
    """Same methods as `saga_fg.tracking.Tracker`; a frame that comes late, up to `max_delay`, is used as a new one."""

    def __init__(self, settings: GreedySettings | None = None, sensors: Mapping[str, Sensor] | None = None) -> None:
        self.settings = GreedySettings() if settings is None else settings
        require_type("settings", self.settings, GreedySettings)
        self.sensors = checked_sensors(sensors)
        self.time_verdict: TimeVerdict = "accepted"  # of the latest frame
        self._clock = Clock()
        self._next_id = 1
        empty = Boxes.empty()
        none = np.empty(0)
        flat = np.empty((0, 2))
        self._memory = _Memory(
            id=np.empty(0, dtype=np.int64),
            label=empty.label,
            position=empty.position,
            size=empty.size,
            yaw=none,
            velocity=flat,
            score=none,
            last_seen=none,
            anchor=flat,
            anchor_time=none,
        )

    def step(self, frame: Frame) -> Tracks:
        """Take in one frame; returns the tracks seen in it, in world coordinates.

        Raises `InputError` for a frame that can't be used; the tracker is then as it was before.
        """
        require_type("frame", frame, Frame)
        sensor = sensor_model(self.sensors, frame.sensor)
        detections = sensor.in_world(frame)
        timestamp = sensor.measured_at(frame)
        verdict, self._clock = self._clock.judged(timestamp, frame.sensor, MAX_JUMP, MAX_DELAY)
        self.time_verdict, now = verdict, self._clock.newest
        if verdict in ("late", "unconfirmed"):
            return self.tracks(now)
        if verdict == "set_back":
            self._memory = self._memory.select(np.empty(0, dtype=np.int64))
        boxes = detections.boxes
        p = sensor.probability(detections.score, boxes.label)
        memory = self._memory
        match = self._match(boxes, p, now)
        seen = match >= 0
        position, velocity = boxes.position[:, :2], boxes.velocity.copy()
        anchor, anchor_time = position.copy(), np.full(len(boxes), now)
        elapsed = now - memory.anchor_time[match[seen]]
        # where the anchor is too young for a difference, since detections are noisy, the velocity stays
        young = elapsed < BASELINE - 1e-6
        moved = (position[seen] - memory.anchor[match[seen]]) / np.maximum(elapsed, 1e-6)[:, None]
        difference = np.where(young[:, None], memory.velocity[match[seen]], moved)
        velocity[seen] = np.where(np.isfinite(velocity[seen]), velocity[seen], difference)
        velocity = np.where(np.isfinite(velocity), velocity, 0.0)
        velocity = np.clip(velocity, -MAX_SPEED, MAX_SPEED)
        anchor[seen] = np.where(young[:, None], memory.anchor[match[seen]], anchor[seen])
        anchor_time[seen] = np.where(young, memory.anchor_time[match[seen]], anchor_time[seen])
        ids = np.empty(len(boxes), dtype=np.int64)
        ids[seen] = memory.id[match[seen]]
        ids[~seen] = np.arange(self._next_id, self._next_id + int((~seen).sum()))
        self._next_id += int((~seen).sum())
        fresh = _Memory(
            id=ids,
            label=boxes.label,
            position=boxes.position,
            size=boxes.size,
            yaw=boxes.yaw,
            velocity=velocity,
            score=p,
            last_seen=np.full(len(boxes), now),
            anchor=anchor,
            anchor_time=anchor_time,
        )
        unseen = np.ones(len(memory.id), dtype=bool)
        unseen[match[seen]] = False
        kept = np.flatnonzero(unseen & (now - memory.last_seen <= self.settings.max_coasting))
        self._memory = fresh.append(memory.select(kept))
        return _tracks(fresh, now)

    def tracks(self, timestamp: float) -> Tracks:
        """The tracks seen in the newest frame, projected to `timestamp` (s)."""
        newest = self._memory.select(np.flatnonzero(self._memory.last_seen == self._clock.newest))
        return _tracks(newest, timestamp)

    @property
    def sensor_times(self) -> dict[str, SensorTime]:
        """The clock of each sensor against the consensus of all, by the order of arrival."""
        return sensor_times(self._clock, SharedObservations())

    @property
    def max_jump(self) -> float:
        """Distance from the newest frame from which another has to be confirmed, s."""
        return MAX_JUMP

    @property
    def plain_snapshots(self) -> bool:
        """Snapshots are plain values."""
        return True

    @property
    def sensor_noise(self) -> dict[str, SensorNoise]:
        """None are found."""
        return {}

    def snapshot(self) -> GreedySnapshot:
        """Everything that the tracker knows, as a value."""
        return GreedySnapshot(self._memory, self._next_id, self._clock, self.time_verdict)

    def restore(self, snapshot: GreedySnapshot) -> None:
        """Continue from a snapshot of a tracker of the same settings."""
        require_type("snapshot", snapshot, GreedySnapshot)
        self._memory, self._next_id, self._clock = snapshot.memory, snapshot.next_id, snapshot.clock
        self.time_verdict = snapshot.time_verdict

    def take_clocks(self, other: GreedyTracker) -> None:
        """Take over the usual steps and the records of the sensors' clocks from a tracker of the scene before."""
        self._clock = other._clock.begun_anew()

    def _match(self, boxes: Boxes, p: FloatArray, now: float) -> IntArray:
        """(m,) row of the track each detection takes, or -1."""
        match = np.full(len(boxes), -1, dtype=np.int64)
        memory = self._memory
        projected = memory.position[:, :2] + memory.velocity * (now - memory.last_seen)[:, None]
        limit = class_numbers(self.settings.max_distance, lambda: GreedySettings().max_distance[DEFAULT], boxes.label)
        d, t = near_pairs(boxes.position[:, :2], projected, limit * (1 + 1e-9))
        distance = np.hypot(*(boxes.position[d, :2] - projected[t]).T)
        possible = (boxes.label[d] == memory.label[t]) & (distance <= limit[d])
        d, t, distance = d[possible], t[possible], distance[possible]
        free = np.ones(len(memory.id), dtype=bool)
        turn = np.empty(len(boxes), dtype=np.int64)
        turn[np.argsort(-p, kind="stable")] = np.arange(len(boxes))
        order = np.lexsort((t, distance, turn[d]))
        for one, other in zip(d[order].tolist(), t[order].tolist(), strict=True):
            if match[one] < 0 and free[other]:
                match[one], free[other] = other, False
        return match


def _tracks(memory: _Memory, timestamp: float) -> Tracks:
    ahead = timestamp - memory.last_seen
    position = memory.position.copy()
    position[:, :2] += memory.velocity * ahead[:, None]
    near = np.flatnonzero((np.abs(position) <= MAX_POSITION).all(axis=1))  # the others are lost
    memory, position, ahead = memory.select(near), position[near], ahead[near]
    nominal = np.tile(NOMINAL_VARIANCE * np.eye(2), (len(memory.id), 1, 1))
    boxes = Boxes(memory.label, position, memory.size, memory.yaw, memory.velocity)
    return Tracks(timestamp, memory.id, boxes, memory.score, nominal, nominal, np.maximum(ahead, 0.0))

"""Measurements of the vehicle's sensors since the last keyframe, joined for the next one."""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import replace

import numpy as np

from saga_fg.errors import InputError
from saga_fg.types.ego_measurements import EgoMeasurements, GpsFix, ImuSamples, WheelSpeed
from saga_fg.types.frame import Detections, Frame

_LOG = logging.getLogger(__name__)


class BetweenKeyframes:
    """Measurements that no keyframe has taken yet.

    sensors: that the graph has; others_read: whether other providers may read the rest; speed_deviation: of wheel
    speeds without one of their own, m/s
    """

    def __init__(self, sensors: Collection[str], others_read: bool, speed_deviation: float) -> None:
        self._sensors, self._others_read, self._speed_deviation = sensors, others_read, speed_deviation
        self._imu: list[ImuSamples] = []
        self._wheels: list[WheelSpeed] = []
        self._fix: tuple[float, GpsFix] | None = None  # the newest, and when it was taken
        self._warned: set[str] = set()

    def check(self, measured: EgoMeasurements) -> None:
        """Raise `InputError` for a measurement that nothing reads, and warn once where only other providers may."""
        for name in ("gps", "imu", "wheels"):
            if getattr(measured, name) is None or name in self._sensors:
                continue
            if not self._others_read:
                raise InputError(f"{name}: expected it among the sensors that were named, as in sensors=[{name!r}]")
            if name not in self._warned:
                _LOG.warning("%s: not among the sensors; only the providers that were given can read it", name)
                self._warned.add(name)

    def add(self, time: float, measured: EgoMeasurements) -> None:
        """Add what came with a scan at `time`, s."""
        self._imu += [] if measured.imu is None else [measured.imu]
        self._wheels += [] if measured.wheels is None else [measured.wheels]
        if measured.gps is not None:
            self._fix = time - measured.gps.age, measured.gps

    def frame(self, time: float, detections: Detections | None) -> Frame | None:
        """The measurements of a keyframe at `time`, s, besides its scan, for providers; the newest fix has its age."""
        if not self._imu and not self._wheels and self._fix is None and detections is None:
            return None
        samples, speed, fix = None, None, None
        if self._imu:
            columns = ("dt", "acceleration", "angular_rate")
            samples = ImuSamples(*(np.concatenate([getattr(one, name) for one in self._imu]) for name in columns))
        if self._wheels:
            speed = self._speed()
        if self._fix is not None:
            fix = replace(self._fix[1], age=max(time - self._fix[0], 0.0))
        ego = EgoMeasurements(gps=fix, imu=samples, wheels=speed)
        return Frame(time, "lidar", Detections.empty() if detections is None else detections, None, "ego", ego=ego)

    def clear(self) -> None:
        """Everything was taken."""
        self._imu, self._wheels, self._fix = [], [], None

    def _speed(self) -> WheelSpeed:
        """The mean speed; errors of the speeds are independent."""
        dt = np.array([one.dt for one in self._wheels])
        share = dt / dt.sum() if dt.sum() > 0 else np.full(len(dt), 1 / len(dt))
        deviation = None
        if any(one.deviation is not None for one in self._wheels):
            own = [self._speed_deviation if one.deviation is None else one.deviation for one in self._wheels]
            deviation = float(np.linalg.norm(share * own))
        return WheelSpeed(float(share @ [one.speed for one in self._wheels]), float(dt.sum()), deviation)

"""Buffer of the vehicle's measurements between two poses of the graph.

Sensors measure at their own times. The buffer takes measurements as they come, each sensor's in order of time, and
gives those up to a pose's time as one `EgoMeasurements`: inertial samples, each for the time since the one before; the
way of the wheels over the time as a mean speed; the latest fix with its age.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, checked
from saga_fg.types.ego_measurements import EgoMeasurements, GpsFix, ImuSamples, WheelSpeed

_LOG = logging.getLogger(__name__)
_LONGEST = 0.5  # s that the first measurement stands for at most; the second one says how long its interval is
_GAP = 3.0  # intervals like the one before, beyond which measurements are missing
_NOTHING = 1e-9  # s


@dataclass(frozen=True, eq=False)
class _Span:
    """A measurement and the time that it stands for, s."""

    start: float
    end: float
    value: FloatArray
    first: bool = False

    def next(self, time: float, value: FloatArray) -> _Span:
        """The measurement after this one, from where this one ends unless some are missing between them."""
        if self.first:
            return _Span(max(self.end, time - _LONGEST), time, value)
        length = self.end - self.start
        return _Span(self.end if time - self.end <= _GAP * length else time - length, time, value)


class SensorBuffer:
    """Measurements that no pose has taken yet. Every method raises `InputError` for time that runs backwards."""

    def __init__(self) -> None:
        self._imu: list[_Span] = []
        self._wheels: list[_Span] = []
        self._gps: list[tuple[float, FloatArray, FloatArray | None]] = []
        self._newest: dict[str, float] = {}
        self._taken = -math.inf
        self._silent: set[str] = set()

    def add_imu(self, time: float, acceleration: FloatArray, angular_rate: FloatArray) -> None:
        """Specific force (3,), m/s^2, and turn rate (3,), rad/s, at `time`, s, for the time since the sample before."""
        both = [checked("imu: acceleration", acceleration, (3,)), checked("imu: angular_rate", angular_rate, (3,))]
        self._in_order("imu", time)
        _add(self._imu, time, np.concatenate(both))

    def add_wheels(self, time: float, speed: float) -> None:
        """Speed ahead, m/s, at `time`, s, for the time since the speed before."""
        if not math.isfinite(speed):
            raise InputError(f"wheels: speed: expected a finite number, got {speed!r}")
        self._in_order("wheels", time)
        _add(self._wheels, time, np.array([speed]))

    def add_gps(self, time: float, position: FloatArray, covariance: FloatArray | None = None) -> None:
        """A place (2,) or (3,), world, m, at `time`, s; covariance, m^2: by the settings if None."""
        fix = GpsFix(position, covariance)
        self._in_order("gps", time)
        self._gps.append((time, fix.position, fix.covariance))

    def take(self, time: float) -> EgoMeasurements:
        """The measurements after the last pose and up to this one, at `time`, s, which then count as taken."""
        if not time > self._taken:
            raise InputError(f"time: expected one after {self._taken:.6f} s, got {time:.6f} s")
        since, self._taken = self._taken, time
        fixes = [one for one in self._gps if since < one[0] <= time]
        for name, spans in (("imu", self._imu), ("wheels", self._wheels)):
            self._notice_gap(name, spans, since, time)
        found = EgoMeasurements(
            gps=GpsFix(fixes[-1][1], fixes[-1][2], time - fixes[-1][0]) if fixes else None,
            imu=_samples(self._imu, since, time),
            wheels=_speed(self._wheels, since, time),
        )
        self._imu, self._wheels = _kept(self._imu, time), _kept(self._wheels, time)
        self._gps = [one for one in self._gps if one[0] > time]
        return found

    def _notice_gap(self, sensor: str, kept: Sequence[_Span], since: float, until: float) -> None:
        """Warn once when a sensor falls silent."""
        if not kept or not math.isfinite(since):
            return
        missing = until - since - float(_spans(kept, since, until).sum())
        silent = missing > _GAP * (kept[0].end - kept[0].start) and kept[0].start < since
        if silent and sensor not in self._silent:
            _LOG.warning("%s: no measurements for %.2f s before %.2f s", sensor, missing, until)
        (self._silent.add if silent else self._silent.discard)(sensor)

    def _in_order(self, sensor: str, time: float) -> None:
        newest = self._newest.get(sensor, -math.inf)
        if not (math.isfinite(time) and time > newest):
            raise InputError(f"{sensor}: expected a time after {newest:.6f} s, got {time:.6f} s")
        if time <= self._taken:
            raise InputError(f"{sensor}: {time:.6f} s comes too late, the pose at {self._taken:.6f} s is estimated")
        self._newest[sensor] = time


def _add(kept: list[_Span], time: float, value: FloatArray) -> None:
    """Add a measurement; the interval between the first two is that of the first, too."""
    if not kept:
        kept.append(_Span(time - _LONGEST, time, value, first=True))
        return
    last = kept[-1]
    kept.append(last.next(time, value))
    if last.first:
        kept[-2] = _Span(last.end - (time - kept[-1].start), last.end, last.value)


def _kept(spans: list[_Span], time: float) -> list[_Span]:
    """Those that reach beyond a time, and the one before them, whose length says what comes next."""
    first = next((k for k, one in enumerate(spans) if one.end > time), len(spans))
    return spans[max(first - 1, 0) :]


def _spans(kept: Sequence[_Span], since: float, until: float) -> FloatArray:
    """Time (n,) that each measurement stands for within an interval, s; the newest also for as long after it."""
    start, end = np.array([(one.start, one.end) for one in kept]).T
    last = int(np.searchsorted(end, until, side="right")) - 1
    if last == len(kept) - 1 and end[last] > since:
        end[last] += min(until - end[last], end[last] - start[last])
    return np.asarray(np.clip(np.minimum(end, until) - np.maximum(start, since), 0.0, None))


def _samples(kept: Sequence[_Span], since: float, until: float) -> ImuSamples | None:
    if not kept or not math.isfinite(since):
        return None
    spans = _spans(kept, since, until)
    used = spans > _NOTHING
    if not used.any():
        return None
    numbers = np.array([one.value for one in kept])[used]
    return ImuSamples(spans[used], numbers[:, :3], numbers[:, 3:])


def _speed(kept: Sequence[_Span], since: float, until: float) -> WheelSpeed | None:
    if not kept or not math.isfinite(since):
        return None
    spans = _spans(kept, since, until)
    total = float(spans.sum())
    if total <= _NOTHING:
        return None
    return WheelSpeed(float(spans @ np.array([one.value[0] for one in kept])) / total, total)

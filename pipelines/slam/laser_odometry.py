"""Odometry of a robot with a planar laser, without implausible steps, and the scale of the wheels.

Along a bare corridor odometry alone tells the way, and wheels of another size than the robot believes err by some per
cent. The scale k is estimated from the steps s that registration determines, as x ahead:

    s_registered = k s_wheels + noise of variance v,        k ~ N(1, 0.05^2)
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from data_tools.laser import LaserLog
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.planar_poses import transforms, vectors

_SLACK = 1.0  # m that a step of the wheels may be longer than the largest speed allows: logs come in bursts
_SCALE = 0.05  # standard deviation of the scale of wheels
_STEP_NOISE = 0.02  # m, of a step that registration determines: it errs with the map
_KNOWN = 0.005  # standard deviation at which the scale is as good as known
_BELIEVED = 0.3  # share of a step by which registration may differ: beyond, wheels slipped, or it erred
_STILL, _CHANGED, _MANY = 1e-6, 0.3, 0.3  # m of the wheels; m of a reading, and the share of a scan, that show motion
_log = logging.getLogger(__name__)


def without_jumps(log: LaserLog, largest_speed: float) -> tuple[FloatArray, int]:
    """Poses (n, 3) of the wheels, where steps faster than `largest_speed` (m/s) count as standing still; their number.

    Steps may be 1 m longer than that speed allows. Warns of the first one.
    """
    wheels = transforms(log.odometry)
    step = np.linalg.inv(wheels[:-1]) @ wheels[1:]
    way, seconds = np.hypot(step[:, 0, 2], step[:, 1, 2]), np.maximum(np.diff(log.time), 0.0)
    jumps = np.flatnonzero(way > largest_speed * seconds + _SLACK)
    if not len(jumps):
        return log.odometry, 0
    first = int(jumps[0])
    _log.warning(
        "scan %d: the wheels moved %.3g m in %.3g s, more than largest_speed, %g m/s, allows; "
        "so in %d steps, which count as standing still",
        first + 2, way[first], seconds[first], largest_speed, len(jumps),
    )  # fmt: skip
    for row in jumps.tolist():  # what follows moves by what the jump did
        wheels[row + 1 :] = wheels[row] @ np.linalg.inv(wheels[row + 1]) @ wheels[row + 1 :]
    return vectors(wheels), len(jumps)


def warn_of_times(time: FloatArray) -> None:
    """Warns where times (n,), s, run backwards, as those of logs that are written by several processes do, or stay."""
    same = np.flatnonzero(np.diff(time) == 0)
    if len(same):
        _log.warning(
            "scan %d: its time is that of the scan ahead of it; so for %d of %d scans, "
            "of which the files have the pose of the first at each time",
            int(same[0]) + 2, len(same), len(time),
        )  # fmt: skip
    back = np.flatnonzero(np.diff(time) < 0)
    if len(back):
        _log.warning(
            "scan %d: its time is %.3g s before that of the scan ahead of it; so for %d of %d scans, "
            "which are taken in the order of the log, with poses written in the order of time",
            int(back[0]) + 2, time[back[0]] - time[back[0] + 1], len(back), len(time),
        )  # fmt: skip


def check_wheels(log: LaserLog) -> None:
    """Raise `InputError` where the wheels say one pose throughout while what the laser sees changes."""
    if len(log) < 2 or np.ptp(log.odometry, axis=0).max() > _STILL:
        return
    changed = (np.abs(log.ranges - log.ranges[0]) > _CHANGED).mean(axis=1)
    if (moved := int(np.argmax(changed > _MANY))) > 0:
        raise InputError(
            f"scan {moved + 1}: {100 * changed[moved]:.0f} % of the readings differ from those of the first scan, but "
            "the wheels stand still throughout: expected odometry"
        )


@dataclass(eq=False)
class WheelScale:
    """Ratio of ways driven to those that the wheels tell, from steps that registration determines."""

    _information: float = _SCALE**-2
    _weighted: float = _SCALE**-2

    @property
    def value(self) -> float:
        """The estimate of k."""
        return self._weighted / self._information

    @property
    def known(self) -> bool:
        """True if more steps hardly change it."""
        return self._information > _KNOWN**-2

    def corrected(self, step: FloatArray) -> FloatArray:
        """A step (3, 3) of the wheels in true metres."""
        scaled = step.copy()
        scaled[:2, 2] *= self.value
        return scaled

    def update(self, predicted: FloatArray, registered: FloatArray, covariance: FloatArray) -> None:
        """Take a corrected step of the wheels and that by registration (3, 3), with the covariance of the latter."""
        wheels, driven = float(predicted[0, 2]) / self.value, float(registered[0, 2])
        if abs(driven - predicted[0, 2]) > _BELIEVED * abs(predicted[0, 2]):
            return
        weight = 1 / (float(covariance[0, 0]) + _STEP_NOISE**2)
        self._information += weight * wheels**2
        self._weighted += weight * wheels * driven

"""Odometry of a robot with a planar laser, without implausible steps."""

from __future__ import annotations

import logging

import numpy as np

from data_tools.laser import LaserLog
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.planar_poses import transforms, vectors

_SLACK = 1.0  # m that a step of the wheels may be longer than the largest speed allows: logs come in bursts
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

"""Comparison of the wheels' speed with the motion by scans, once, over the first way on which scans show the motion.

The ratio k of both is the median over scans, with deviation 1.25 s / sqrt(n), s by the median absolute deviation. Until
then speeds enter the graph only where scans leave motions open. Within `_SURE` deviations of 1, that of k and the
`share` of the settings together, wheels are taken as they are. Beyond, the speed is divided by k from then on; it is
left out if k changes too much, or is none that radius or calibration of wheels explain.
"""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np

from pipelines.slam.odometry import OdometryStep
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform
from saga_fg.providers import Wheels
from saga_fg.providers.mounting import mounting
from saga_fg.types.ego_measurements import WheelSpeed

_WAY, _LEAST = 15.0, 15  # m and scans that are compared
_MOVING = 1.0  # m/s from which a speed tells a scale
_SURE = 3.0  # deviations
_SCALES, _SPREAD = (0.75, 1.33), 0.1  # of wheels that are scaled, and the largest s of theirs


class WheelComparison:
    """Takes each speed before its scan is placed (`corrected`), and the scan after (`used`, `update`).

    settings: of the wheels; ego_T_lidar: (4, 4) pose of the LiDAR on the vehicle
    """

    def __init__(self, settings: Wheels, ego_T_lidar: FloatArray) -> None:
        self._settings = settings
        self._lidar_T_axle = inverse_transform(ego_T_lidar) @ mounting("mounted", settings.mounted).matrix()
        self._scale: float | None = 1.0  # None: left out
        self._raw: WheelSpeed | None = None
        self._used: WheelSpeed | None = None
        self._last: OdometryStep | None = None
        self._ratios, self._way, self._judged = list[float](), 0.0, settings.estimate_scale

    def corrected(self, wheels: WheelSpeed | None) -> WheelSpeed | None:
        """The speed to use; None if wheels are left out."""
        self._raw = self._used = wheels
        if wheels is not None and self._scale != 1:
            self._used = None if self._scale is None else replace(wheels, speed=self._scale * wheels.speed)
        return self._used

    def used(self, step: OdometryStep) -> WheelSpeed | None:
        """The speed that enters the graph with a scan that was placed."""
        shown = step.registration is not None and not step.degenerate
        return self._used if self._judged or not shown else None

    def update(self, step: OdometryStep) -> str:
        """Compare the last speed with the motion to a scan; returns once what does not fit, in words."""
        last, self._last = self._last, step if step.registration is not None and not step.degenerate else None
        if self._judged or self._raw is None or last is None or self._last is None:
            return ""
        dt = step.timestamp - last.timestamp
        moved = inverse_transform(last.map_T_lidar @ self._lidar_T_axle) @ step.map_T_lidar @ self._lidar_T_axle
        speed = float(gtsam.Pose3.Logmap(gtsam.Pose3(moved))[3]) / dt
        if abs(speed) < _MOVING or abs(self._raw.dt - dt) > dt / 2:
            return ""
        self._ratios.append(self._raw.speed / speed)
        self._way += abs(speed) * dt
        return self._judged_misfit() if self._way >= _WAY and len(self._ratios) >= _LEAST else ""

    def _judged_misfit(self) -> str:
        ratio = float(np.median(self._ratios))
        spread = 1.4826 * float(np.median(np.abs(np.array(self._ratios) - ratio)))
        deviation = np.hypot(self._settings.share, 1.25 * spread / np.sqrt(len(self._ratios)))
        self._judged = True
        allowed = _SURE * deviation
        if abs(ratio - 1) <= allowed:
            return ""
        scaled = 1 / ratio if _SCALES[0] <= ratio <= _SCALES[1] and spread <= _SPREAD else None
        self._scale = scaled
        then = "they are left out from here on" if scaled is None else f"it is multiplied by {scaled:.3f} from here on"
        return (
            f"{self._settings.name}: over the first {self._way:.0f} m their speed is {ratio:.3f} times that by the "
            f"scans, where its settings and the spread of the ratio allow {allowed:.1%} off; {then}"
        )

"""Where a sensor is on the vehicle, and what it sees."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.numerics.geometry import wrap_angle, yaw_transform
from saga_fg.settings import Finite, PositiveOrInf, Settings, setting


@dataclass(frozen=True)
class FieldOfView(Settings):
    """The field of view of a sensor, in its own frame."""

    min_azimuth: Finite = setting(
        -np.pi, "smallest azimuth, from straight ahead, left positive, rad; misses beyond do not count"
    )
    max_azimuth: Finite = setting(
        np.pi, "largest azimuth, from straight ahead, left positive, rad; misses beyond do not count"
    )
    max_range: PositiveOrInf = setting(
        80.0,
        "largest range, m; misses beyond do not count; usual 40 to 120; higher: distant tracks die of misses sooner",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.max_azimuth < self.min_azimuth:
            raise InputError(
                f"max_azimuth: expected at least min_azimuth {self.min_azimuth:g}, got {self.max_azimuth:g}"
            )

    def holds(self, distance: FloatArray, azimuth: FloatArray) -> BoolArray:
        """Mask (N,) of places, m and rad, inside it; unknown ones (NaN) count as inside."""
        middle, half = (self.min_azimuth + self.max_azimuth) / 2, (self.max_azimuth - self.min_azimuth) / 2
        aside = np.abs(wrap_angle(azimuth - middle))
        return np.asarray(~(distance > self.max_range) & ~(aside > half + 1e-9))


@dataclass(frozen=True)
class Extrinsics(Settings):
    """Pose of the sensor on the vehicle, ego_T_sensor, for detections given in sensor coordinates."""

    x: Finite = setting(0.0, "position of the sensor ahead of the vehicle's origin, m; usual -2 to 4")
    y: Finite = setting(0.0, "position of the sensor to the left of the vehicle's origin, m; usual -1 to 1")
    z: Finite = setting(0.0, "position of the sensor above the vehicle's origin, m; usual 0 to 2.5")
    yaw: Finite = setting(0.0, "heading of the sensor in the vehicle's frame, rad; 0: ahead, higher: further left")

    @cached_property
    def ego_T_sensor(self) -> FloatArray:
        """(4, 4), read-only."""
        transform = yaw_transform(self.x, self.y, self.z, self.yaw)
        transform.flags.writeable = False
        return transform

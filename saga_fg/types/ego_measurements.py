"""Ego measurements of a frame: odometry, GPS, inertial samples, wheel speed, landmarks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError, require_type
from saga_fg.numerics.arrays import FloatArray, checked, checked_covariances
from saga_fg.types.landmark import Observation

_TANGENT = {3: 3, 4: 6}  # dimension of the motions of so large a transform


@dataclass(frozen=True, eq=False)
class OdometryIncrement:
    """Motion of the vehicle over the last `dt` s.

    before_T_now  where it is now in its frame of then, (3, 3) in the plane or (4, 4) in space
    covariance    (3, 3) of (x, y, heading), or (6, 6) of (rotation vector, translation), in the frame of now, m and
                  rad; None: by the provider's settings
    """

    before_T_now: FloatArray
    dt: float
    covariance: FloatArray | None = None

    def __post_init__(self) -> None:
        from factors import FactorError, pose  # GTSAM, which frames without odometry do not need

        motion = checked("odometry", self.before_T_now, (None, None))
        if motion.shape not in ((3, 3), (4, 4)):
            raise InputError(f"odometry: expected a 3 x 3 or 4 x 4 transform, got shape {motion.shape}")
        try:
            pose("odometry", motion)
        except FactorError as error:
            raise InputError(str(error)) from error
        if not (isinstance(self.dt, int | float) and math.isfinite(self.dt) and self.dt > 0):
            raise InputError(f"odometry: dt: expected a finite number of seconds > 0, got {self.dt!r}")
        covariance = _covariance("odometry: covariance", self.covariance, _TANGENT[len(motion)])
        vars(self).update(before_T_now=motion, covariance=covariance)


@dataclass(frozen=True, eq=False)
class GpsFix:
    """A measured place, (2,) or (3,), world, m.

    covariance  (2, 2) or (3, 3), None: by the provider's settings
    age         s between the fix and the frame that brings it
    """

    position: FloatArray
    covariance: FloatArray | None = None
    age: float = 0.0

    def __post_init__(self) -> None:
        _check_number("gps: age", self.age, 0.0)
        place = checked("gps", self.position, (None,))
        if len(place) not in (2, 3):
            raise InputError(f"gps: expected a place of 2 or 3 coordinates, got {len(place)}")
        vars(self).update(position=place, covariance=_covariance("gps: covariance", self.covariance, len(place)))


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """n >= 1 samples since the frame before, in the vehicle's axes.

    dt (n,) s that each stands for; acceleration (n, 3) specific force, m/s^2: (0, 0, 9.81) at rest on level ground;
    angular_rate (n, 3), rad/s
    """

    dt: FloatArray
    acceleration: FloatArray
    angular_rate: FloatArray

    def __post_init__(self) -> None:
        dt = checked("imu: dt", self.dt, (None,))
        if len(dt) == 0:
            raise InputError("imu: expected at least one sample, got none")
        if not (dt > 0).all():
            raise InputError(f"imu: dt[{int(np.argmin(dt))}]: expected a number of seconds > 0, got {dt.min():g}")
        vars(self)["dt"] = dt
        for name in ("acceleration", "angular_rate"):
            vars(self)[name] = checked(f"imu: {name}", getattr(self, name), (len(dt), 3))


@dataclass(frozen=True, eq=False)
class WheelSpeed:
    """Mean speed ahead over the last `dt` s, m/s, negative backwards; deviation, m/s: None: by the settings."""

    speed: float
    dt: float
    deviation: float | None = None

    def __post_init__(self) -> None:
        _check_number("wheels: speed", self.speed, -math.inf)
        _check_number("wheels: dt", self.dt, 0.0)
        if self.deviation is not None:
            _check_number("wheels: deviation", self.deviation, 0.0)


@dataclass(frozen=True, eq=False)
class EgoMeasurements:
    """All of them, as far as there are any; landmarks: what is seen of each, by its id."""

    odometry: OdometryIncrement | None = None
    gps: GpsFix | None = None
    imu: ImuSamples | None = None
    landmarks: Mapping[int, Observation] = field(default_factory=dict)
    wheels: WheelSpeed | None = None

    def __post_init__(self) -> None:
        for name, kind in (
            ("odometry", OdometryIncrement),
            ("gps", GpsFix),
            ("imu", ImuSamples),
            ("wheels", WheelSpeed),
        ):
            value = getattr(self, name)
            if value is not None:
                require_type(name, value, kind)
        if not isinstance(self.landmarks, Mapping) or not all(
            isinstance(seen, Observation) for seen in self.landmarks.values()
        ):
            raise InputError("landmarks: expected Observations by the ids of their landmarks")


def _covariance(name: str, value: ArrayLike | None, dim: int) -> FloatArray | None:
    return None if value is None else checked_covariances(name, checked(name, value, (dim, dim))[None], 1, dim)[0]


def _check_number(name: str, value: float, least: float) -> None:
    if not (isinstance(value, int | float | np.floating) and math.isfinite(value) and value >= least):
        raise InputError(f"{name}: expected a finite number{' >= 0' if least == 0 else ''}, got {value!r}")

"""Settings of the joint estimation of the vehicle's path and the objects around it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from saga_fg.errors import InputError
from saga_fg.settings import (
    Positive,
    PositiveInt,
    PositiveOrInf,
    Settings,
    setting,
    settings_group,
)
from saga_fg.slam.joint.odometry import OdometryNoise
from saga_fg.types.by_class import DEFAULT

MAX_ITERATIONS = 30  # largest number of linearisations in each pass
KEYFRAME_PERIOD = 0.15  # skip frames that follow a keyframe within this time, s


@dataclass(frozen=True)
class JointSettings(Settings):
    """Noise of the odometry, stationarity of objects, and effort of the joint estimation."""

    odometry: OdometryNoise = settings_group(OdometryNoise, "errors of the odometry")
    stationary_window: Positive = setting(
        3.0, "time over which an object is judged stationary or moving, s; higher: surer, later"
    )
    moving_speed: Mapping[str, Positive] = settings_group(
        lambda: {DEFAULT: 5.0, "pedestrian": 1.0},
        "standard deviation of the velocity of moving objects by class, m/s; default serves all others",
    )
    outlier_scale: PositiveOrInf = setting(
        3.0,
        "residual from which the Cauchy loss discounts a detection, standard deviations; usual 2 to 5; "
        "higher: outliers count more",
    )
    lanes: bool = setting(False, "attract moving vehicles to the lanes of a map")
    passes: PositiveInt = setting(
        3, "most passes of associating objects along the latest path; they end when associations repeat; higher: slower"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if DEFAULT not in self.moving_speed:
            raise InputError(f"moving_speed: expected an entry {DEFAULT}, got {dict(self.moving_speed)}")

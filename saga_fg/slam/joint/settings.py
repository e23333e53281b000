"""Settings of the joint estimation of the vehicle's path and the objects around it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from saga_fg.errors import InputError
from saga_fg.model.edge_rules import VEHICLES
from saga_fg.settings import (
    NonNegative,
    Positive,
    PositiveInt,
    PositiveOrInf,
    Range,
    Settings,
    setting,
    settings_group,
)
from saga_fg.slam.joint.odometry import OdometryNoise
from saga_fg.types.by_class import DEFAULT


@dataclass(frozen=True)
class LaneSettings(Settings):
    """Attraction of vehicles to the centre lines of the map's lanes."""

    offset_deviation: Positive = setting(
        0.3, "standard deviation of the offset from the centre line, m; lower: stronger attraction"
    )
    offset_time: Positive = setting(5.0, "correlation time of the offset of one driver, s")
    lateral_speed_scale: PositiveOrInf = setting(
        0.8, "sigma of the kernel on the speed across the lane, m/s; lower: vehicles that leave it are let go sooner"
    )
    off_lane_share: Positive = setting(
        0.1, "vehicles outside all lanes, as a share of those in one; higher: fewer are assigned to a lane"
    )
    classes: tuple[str, ...] = setting(VEHICLES, "classes of objects that take part")
    passes: Annotated[int, Range(1, 100)] = setting(3, "passes of assigning vehicles to lanes along the latest path")


@dataclass(frozen=True)
class JointSettings(Settings):
    """Noise of the odometry, stationarity of objects, and effort of the joint estimation."""

    odometry: OdometryNoise = settings_group(OdometryNoise, "errors of the odometry")
    stationary_window: Positive = setting(
        3.0, "time over which an object is judged stationary or moving, s; higher: surer, later"
    )
    online_stationary_share: Annotated[float, Range(1e-06, 1 - 1e-06)] = setting(
        0.1, "prior share of stationary objects online; low, since slow queues look parked for a while"
    )
    moving_speed: Mapping[str, Positive] = settings_group(
        lambda: {DEFAULT: 5.0, "pedestrian": 1.0},
        "standard deviation of the velocity of moving objects by class, m/s; default serves all others",
    )
    stationary_drift: Positive = setting(
        0.05,
        "standard deviation of the drift of a stationary object in one second, m; usual 0.01 to 0.1; lower: "
        "stationary objects hold the path more firmly",
    )
    stationary_speed: Positive = setting(
        0.1,
        "standard deviation of the velocity of a stationary object, m/s; higher: slow objects are taken for stationary",
    )
    outlier_scale: PositiveOrInf = setting(
        3.0,
        "residual from which the Cauchy loss discounts a detection, standard deviations; usual 2 to 5; "
        "higher: outliers count more",
    )
    max_landmark_distance: Positive = setting(
        2.5,
        "largest distance between two observations of one landmark, m; usual 1 to 4; higher: more matches, "
        "right and wrong",
    )
    lanes: LaneSettings | None = settings_group(
        lambda: None, "attraction of moving vehicles to the lanes of a map; null: none"
    )
    keyframe_period: NonNegative = setting(
        0.15, "skip frames that follow a keyframe within this time, s; higher: faster, coarser"
    )
    passes: PositiveInt = setting(
        3, "most passes of associating objects along the latest path; they end when associations repeat; higher: slower"
    )
    max_iterations: PositiveInt = setting(
        30, "largest number of linearisations in each pass; usual 10 to 50; higher: slower where they do not converge"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if DEFAULT not in self.moving_speed:
            raise InputError(f"moving_speed: expected an entry {DEFAULT}, got {dict(self.moving_speed)}")

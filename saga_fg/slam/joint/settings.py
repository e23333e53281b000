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

    spread: Positive = setting(0.3, "how far from the centre line drivers keep, standard deviation, m")
    memory: Positive = setting(5.0, "time over which a driver keeps his distance from the line, s")
    drift: PositiveOrInf = setting(
        0.8, "sigma of the kernel on the speed across the lane, m/s: who leaves it is let go"
    )
    elsewhere: Positive = setting(0.1, "vehicles that drive along no lane, as a share of those in one")
    classes: tuple[str, ...] = setting(VEHICLES, "classes that take part")
    rounds: Annotated[int, Range(1, 100)] = setting(
        3, "how often vehicles are assigned to lanes anew, along the path found with the last lanes"
    )


@dataclass(frozen=True)
class JointSettings(Settings):
    """Noise of the odometry, stationarity of objects, and effort of the joint estimation."""

    odometry: OdometryNoise = settings_group(OdometryNoise, "how good the odometry is")
    start_noise: Positive = setting(1e-3, "standard deviation of the first pose, m and rad")
    standing_window: Positive = setting(3.0, "time over which an object is judged to stand or to move, s")
    online_standing_share: Annotated[float, Range(1e-06, 1 - 1e-06)] = setting(
        0.1, "share of objects expected to stand, online, where queues that creep look parked for a while"
    )
    moving_speed: Mapping[str, Positive] = settings_group(
        lambda: {DEFAULT: 5.0, "pedestrian": 1.0},
        "deviation of a velocity component of objects that move, by class, m/s",
    )
    standing_drift: Positive = setting(0.05, "how far an object that stands may wander, m after one second")
    standing_speed: Positive = setting(0.1, "standard deviation of the velocity of an object that stands, m/s")
    motion_noise: Positive = setting(
        1000.0, "factor on the noise of the objects' motion: traffic brakes and turns as one"
    )
    online_motion_noise: Positive = setting(
        1.0, "the same online, where the objects' velocities are wanted as they come"
    )
    outlier_scale: PositiveOrInf = setting(
        3.0, "detections farther off than this count less (Cauchy), standard deviations"
    )
    landmark_reach: Positive = setting(
        2.5, "a landmark seen farther than this from where it was last is another one, m"
    )
    lanes: LaneSettings | None = settings_group(
        lambda: None, "attraction of moving vehicles to the lanes of a map, where there is one; null: none"
    )
    keyframe_period: NonNegative = setting(0.15, "frames that follow a keyframe within this time are passed over, s")
    rounds: PositiveInt = setting(2, "how often objects are associated anew along the path estimated so far")
    max_iterations: PositiveInt = setting(30, "linearisations at most, in each round")

    def __post_init__(self) -> None:
        super().__post_init__()
        if DEFAULT not in self.moving_speed:
            raise InputError(f"moving_speed: expected an entry {DEFAULT}, got {dict(self.moving_speed)}")

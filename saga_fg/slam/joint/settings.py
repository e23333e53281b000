"""Settings of the joint estimation of the vehicle's path and the objects around it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from saga_fg.errors import InputError
from saga_fg.model.edge_rules import VEHICLES
from saga_fg.settings import require_between, require_positive, setting, settings_group
from saga_fg.slam.joint.odometry import OdometryNoise
from saga_fg.types.by_class import DEFAULT


@dataclass(frozen=True)
class LaneSettings:
    """How vehicles are drawn to the centre lines of the map's lanes."""

    spread: float = setting(0.3, "how far from the centre line drivers keep, standard deviation, m")
    memory: float = setting(5.0, "time over which a driver keeps his distance from the line, s")
    drift: float = setting(0.8, "sigma of the kernel on the speed across the lane, m/s: who leaves it is let go")
    elsewhere: float = setting(0.1, "vehicles that drive along no lane, as a share of those in one")
    classes: tuple[str, ...] = setting(VEHICLES, "classes that take part")
    rounds: int = setting(3, "how often vehicles are assigned to lanes anew, along the path found with the last lanes")

    def __post_init__(self) -> None:
        require_positive(self, "spread", "memory", "elsewhere")
        require_positive(self, "drift", infinite=True)
        require_between(self, 1, 100, "rounds")


@dataclass(frozen=True)
class JointSettings:
    """What the estimator knows of the odometry, of objects that stand, and how hard it tries."""

    odometry: OdometryNoise = settings_group(OdometryNoise, "how good the odometry is")
    start_noise: float = setting(1e-3, "standard deviation of the first pose, m and rad")
    standing_window: float = setting(3.0, "time over which an object is judged to stand or to move, s")
    online_standing_share: float = setting(
        0.1, "share of objects expected to stand, online, where queues that creep look parked for a while"
    )
    moving_speed: Mapping[str, float] = field(
        default_factory=lambda: {DEFAULT: 5.0, "pedestrian": 1.0},
        metadata={"comment": "deviation of a velocity component of objects that move, by class, m/s"},
    )
    standing_drift: float = setting(0.05, "how far an object that stands may wander, m after one second")
    standing_speed: float = setting(0.1, "standard deviation of the velocity of an object that stands, m/s")
    motion_noise: float = setting(1000.0, "factor on the noise of the objects' motion: traffic brakes and turns as one")
    online_motion_noise: float = setting(1.0, "the same online, where the objects' velocities are wanted as they come")
    outlier_scale: float = setting(3.0, "detections farther off than this count less (Cauchy), standard deviations")
    landmark_reach: float = setting(2.5, "a landmark seen farther than this from where it was last is another one, m")
    lanes: LaneSettings | None = settings_group(
        lambda: None, "attraction of moving vehicles to the lanes of a map, where there is one; null: none"
    )
    keyframe_period: float = setting(0.15, "frames that follow a keyframe within this time are passed over, s")
    rounds: int = setting(2, "how often objects are associated anew along the path estimated so far")
    max_iterations: int = setting(30, "linearisations at most, in each round")

    def __post_init__(self) -> None:
        require_positive(self, "start_noise", "standing_window", "standing_drift", "standing_speed")
        require_positive(self, "motion_noise", "online_motion_noise", "landmark_reach")
        if DEFAULT not in self.moving_speed or not all(0 < speed < math.inf for speed in self.moving_speed.values()):
            raise InputError(
                f"moving_speed: expected positive numbers by class, {DEFAULT} among them, got {dict(self.moving_speed)}"
            )
        require_positive(self, "outlier_scale", infinite=True)
        require_between(self, 0, math.inf, "keyframe_period")
        require_between(self, 1e-6, 1 - 1e-6, "online_standing_share")
        for name in ("rounds", "max_iterations"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: expected a whole number of at least 1, got {getattr(self, name)!r}")

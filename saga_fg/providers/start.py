"""The first pose of the vehicle, with a prior."""

from __future__ import annotations

import math
from dataclasses import dataclass

import gtsam
import numpy as np

from factors import Pose, pose, pose_prior_factor
from saga_fg.errors import InputError
from saga_fg.graph.keys import EGO_POSE
from saga_fg.graph.providers import Additions, GraphView
from saga_fg.graph.variables import NewVariable
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import yaw_of, yaw_transform
from saga_fg.settings import Positive, Settings, setting
from saga_fg.types.frame import Frame

NO_POSE = "expected a provider that adds the vehicle's pose before it, such as saga_fg.providers:Odometry"


@dataclass(frozen=True)
class StartSettings(Settings):
    """The vehicle's first pose."""

    place: tuple[float, float, float] | None = setting(
        None, "x, y (m) and yaw (rad) in the world; null: world_T_ego of the first frame, else its GPS fix and yaw 0"
    )
    deviation: Positive = setting(1.0, "standard deviation of the position, m")
    heading_deviation: Positive = setting(0.1, "standard deviation of the heading, rad")
    tilt_deviation: Positive = setting(0.02, "standard deviation of roll and pitch of poses in space, rad")
    planar: bool = setting(True, "true: poses (x, y, heading), gtsam.Pose2; false: poses in space, gtsam.Pose3")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.place is not None and not all(map(math.isfinite, self.place)):
            raise InputError(f"place: expected finite numbers, got {self.place!r}")

    def additions(self, view: GraphView) -> Additions:
        """The first pose with its prior; none where the vehicle has a pose already."""
        if view.now(EGO_POSE) or view.before(EGO_POSE):
            return Additions()
        world_T_ego = self.transform(view.frame)
        world_T_ego[:2, 3] -= view.origin
        if self.planar:
            start: Pose = gtsam.Pose2(float(yaw_of(world_T_ego[:3, :3])), world_T_ego[:2, 3])
            sigmas = [self.deviation, self.deviation, self.heading_deviation]
        else:
            start = pose("start", world_T_ego)
            sigmas = [self.tilt_deviation, self.tilt_deviation, self.heading_deviation] + 3 * [self.deviation]
        prior = pose_prior_factor(view.key(EGO_POSE, 0), start.matrix(), np.diag(np.square(sigmas)))
        return Additions([NewVariable(EGO_POSE, 0, start, label="vehicle")], [prior])

    def transform(self, frame: Frame | None) -> FloatArray:
        """world_T_ego (4, 4) as settings or a frame have it."""
        if self.place is not None:
            x, y, yaw = self.place
            return yaw_transform(x, y, 0.0, yaw)
        if frame is not None and frame.world_T_ego is not None:
            return frame.world_T_ego.copy()
        start = np.eye(4)
        if frame is not None and frame.ego is not None and frame.ego.gps is not None:
            place = frame.ego.gps.position
            start[: len(place), 3] = place
        return start

"""Providers of the vehicle's own motion: first pose, and odometry.

The vehicle's pose from epoch to epoch, by odometry.

    r = log( measured^-1 before^-1 now ),    measured = before_T_now of the interval

An increment over other times than the epoch's is taken for a steady motion, of which the epoch has its share: the
motion's logarithm times the share, its covariance as well. Without an increment the vehicle may be anywhere nearby.
"""

import math
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from factors import Pose, between_factor, pose, pose_prior_factor
from saga_fg.errors import InputError
from saga_fg.graph import EGO_POSE, Additions, GraphView, NewVariable
from saga_fg.numerics import FloatArray, yaw_of, yaw_transform
from saga_fg.settings import Positive, Settings, setting, settings_group
from saga_fg.types import Frame, OdometryIncrement

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


_SAME = 1e-4  # relative difference of two intervals that timestamps make
UNKNOWN_SPEED = 10.0  # standard deviation of the velocity where there is no increment, m/s
UNKNOWN_TURN = 0.3  # standard deviation of the turn rate where there is no increment, rad/s


@dataclass(frozen=True)
class Odometry(Settings):
    """Adds the vehicle's pose at every epoch, and the increments of odometry (`frame.ego.odometry`)."""

    start: StartSettings = settings_group(StartSettings, "first pose")
    place_drift: Positive = setting(
        0.1, "standard deviation of the position after one second, for increments without a covariance, m"
    )
    heading_drift: Positive = setting(
        0.01, "standard deviation of heading, roll and pitch after one second, likewise, rad"
    )
    name = "odometry"

    def predict(self, view: GraphView) -> Additions:
        before = view.before(EGO_POSE)
        if not before:
            return self.start.additions(view)
        last, key = before[0].key, view.key(EGO_POSE, 0)
        planar = isinstance(view.state(last), gtsam.Pose2)
        motion, covariance = self._motion(view, planar)
        state = view.state(last).compose(motion)
        new = [] if view.now(EGO_POSE) else [NewVariable(EGO_POSE, 0, state, label="vehicle")]
        return Additions(new, [between_factor(last, key, motion.matrix(), covariance)])

    def factors(self, view: GraphView) -> Additions:
        return Additions()

    def _motion(self, view: GraphView, planar: bool) -> tuple[Pose, FloatArray]:
        """Motion of this epoch, with the covariance of its tangent."""
        ego = None if view.frame is None else view.frame.ego
        if ego is None or ego.odometry is None:
            stationary: Pose = gtsam.Pose2() if planar else gtsam.Pose3()
            return stationary, self._covariance(UNKNOWN_SPEED * view.dt, UNKNOWN_TURN * view.dt, planar)
        reported = ego.odometry
        motion = _motion_of(reported, planar)
        covariance = reported.covariance
        if covariance is None:
            covariance = self._covariance(self.place_drift, self.heading_drift, planar) * reported.dt
        share = view.dt / reported.dt
        if abs(share - 1) <= _SAME:
            return motion, covariance
        still: Any = type(motion)()
        return still.expmap(share * still.logmap(motion)), share * max(share, 1.0) * covariance

    def _covariance(self, place: float, heading: float, planar: bool) -> FloatArray:
        sigmas = [place, place, heading] if planar else 3 * [heading] + 3 * [place]
        return np.diag(np.square(sigmas))


def _motion_of(reported: OdometryIncrement, planar: bool) -> Pose:
    wanted = 3 if planar else 4
    if len(reported.before_T_now) != wanted:
        n = len(reported.before_T_now)
        raise InputError(f"odometry: expected a {wanted} x {wanted} transform, as poses are, got {n} x {n}")
    return pose("odometry", reported.before_T_now)

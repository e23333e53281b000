"""The vehicle's pose from epoch to epoch, by odometry.

    r = log( measured^-1 before^-1 now ),    measured = before_T_now of the interval

An increment over other times than the epoch's is taken for a steady motion, of which the epoch has its share: the
motion's logarithm times the share, its covariance as well. Without an increment the vehicle may be anywhere nearby.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from factors import Pose, between_factor, pose
from saga_fg.errors import InputError
from saga_fg.graph.keys import EGO_POSE
from saga_fg.graph.providers import Additions, GraphView
from saga_fg.graph.variables import NewVariable
from saga_fg.numerics.arrays import FloatArray
from saga_fg.providers.start import StartSettings
from saga_fg.settings import Positive, Settings, setting, settings_group
from saga_fg.types.ego_measurements import OdometryIncrement

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
        new = (
            [] if view.now(EGO_POSE) else [NewVariable(EGO_POSE, 0, view.state(last).compose(motion), label="vehicle")]
        )
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

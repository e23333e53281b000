"""The vehicle's path frame by frame: odometry without the slow errors that stationary objects tell.

Over the last `LAG` seconds a graph has the poses, the slow errors of the odometry and the places of objects that are
stationary with `LIKELY` and more (`saga_fg.slam.joint.record`), whose detections count with `CORRELATED` times their
covariance: a detector errs alike from frame to frame. Moving objects are not in it, nor are frames within
`KEYFRAME_PERIOD` of a keyframe: they are tracked alone. The first pose of the lag is held, its errors have the estimate
that they had when they were newest, after their random walk since the keyframe before, or none if that estimate was
rejected. The path goes on by increments without the errors, so that it does not jump and tracks along it keep their
velocities.

The estimate steps aside where it contradicts the odometry. With errors e ~ N(0, P0) by the device's noise, estimated
as m with the covariance P, m is N(0, P0 - P): where the sum of m_i^2 / (P0 - P)_ii exceeds `LIMIT`, 99 % of chi^2 with
three degrees of freedom, what seems to stand does not, or the detector is wrong, and the path goes on by the odometry
as it is. P0 grows with the random walk since the start. The path goes on by odometry, too, where the graph of a frame
did not converge. Where few objects stand, m is small and so is what it changes.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import gtsam
import numpy as np

from factors import ERROR_DIM, ResidualFactors, SolverSettings, relative_factors, solve
from saga_fg.numerics import (
    FloatArray,
    carried_covariance,
    checked,
    checked_covariances,
    checked_transform,
    inverse_transform,
    transform_points,
)
from saga_fg.slam.joint.graph import (
    LIKELY,
    START_NOISE,
    TOLERANCE,
    detection_loss,
    error_key,
    object_key,
    odometry,
)
from saga_fg.slam.joint.odometry_noise import without_errors
from saga_fg.slam.joint.record import (
    KEYFRAME_PERIOD,
    EpochRecorder,
    JointSettings,
    RecordedEpoch,
    stationary_probabilities,
)
from saga_fg.slam.mapping import pose_key
from saga_fg.tracking import Tracker
from saga_fg.types import Frame, Tracks

log = logging.getLogger(__name__)

LAG = 20.0  # s; usual 10 to 40; longer: the errors are surer, and it takes longer
CORRELATED = 4.0  # factor on the covariance of detections of stationary objects
LIMIT = 11.34  # chi^2, see above
_ITERATIONS = 8  # largest number of linearisations a frame
_LEAST_SHARE = 0.05  # of its prior variance, with which an estimated error is tested


@dataclass(frozen=True)
class _Epoch:
    """An epoch of the window: its pose (4, 4) and errors (3,) as solved last; the errors (3,) and their covariance
    (3, 3) before it, which are its prior when it is the first."""

    record: RecordedEpoch
    pose: FloatArray
    errors: FloatArray
    prior: FloatArray
    prior_covariance: FloatArray


@dataclass(frozen=True)
class _Motion:
    """Since a keyframe: as reported (4, 4), the covariance (6, 6) if each part has one, without the errors (4, 4)."""

    reported: FloatArray
    covariance: FloatArray | None
    mended: FloatArray

    def followed_by(self, a_T_b: FloatArray, covariance: FloatArray | None, mended: FloatArray) -> Self:
        """With the motion of the next frame behind it."""
        if self.covariance is not None and covariance is not None:
            covariance = carried_covariance(inverse_transform(a_T_b), self.covariance) + covariance
        else:
            covariance = None
        return replace(self, reported=self.reported @ a_T_b, covariance=covariance, mended=self.mended @ mended)


_AT_REST = _Motion(np.eye(4), np.zeros((6, 6)), np.eye(4))


class OnlinePath:
    """A tracker along the path that it mends, one frame after the other.

    `JointSettings.passes` has no effect: each frame is associated once.

    world_T_ego  (4, 4) newest pose
    errors       (3,) estimated scale, bias of the yaw rate (rad/s) and course (rad) of the odometry
    covariance   (3, 3) of these
    aside        whether they contradict its noise, so that the path goes on by odometry alone
    """

    def __init__(
        self, tracker: Tracker, settings: JointSettings | None = None, start: FloatArray | None = None
    ) -> None:
        self.settings = settings or JointSettings()
        self.world_T_ego = np.eye(4) if start is None else checked_transform("start", start)
        self.errors, self.covariance, self.aside = np.zeros(ERROR_DIM), np.diag(self.settings.odometry.slow**2), False
        self._recorder, self._motion, self._start, self._newest = EpochRecorder(tracker), _AT_REST, 0.0, 0.0
        self._window: list[_Epoch] = []

    def step(self, frame: Frame, a_T_b: FloatArray, covariance: FloatArray | None = None) -> Tracks:
        """Take in a frame, after a motion a_T_b (4, 4) since the one before, and return the tracks.

        a_T_b is the identity for the first frame; covariance: (6, 6) of it, as in `OdometryIncrements`. Raises
        `InputError` for a motion or a covariance that is none, and for a frame that is not later than the last one, or
        in world coordinates without a pose.
        """
        a_T_b = checked_transform("a_T_b", a_T_b)
        if covariance is not None:
            stated = checked("covariance", covariance, (6, 6))
            covariance = checked_covariances("covariance", stated[None], 1, 6)[0]
        number, pose, motion = 0, self.world_T_ego, self._motion
        if self._window:
            number = self._window[-1].record.epoch + 1
            mended = without_errors(a_T_b, self.errors, frame.timestamp - self._newest)
            pose = pose @ (a_T_b if self.aside else mended)
            motion = motion.followed_by(a_T_b, covariance, mended)
        now = self._recorder.add(number, frame, pose, motion.reported, motion.covariance)
        self.world_T_ego, self._motion, self._newest = pose, motion, now.time
        if not self._window or now.time > self._window[-1].record.time + KEYFRAME_PERIOD:
            self._add(now)
        return self._recorder.tracks

    def _add(self, now: RecordedEpoch) -> None:
        """A keyframe."""
        solved = self.world_T_ego
        if self._window:
            last = self._window[-1]
            solved = last.pose @ self._motion.mended
            prior, covariance = self.errors, self.covariance + np.diag(self._wandered(now.time - last.record.time))
        else:
            self._start = now.time
        if self.aside or not self._window:
            prior, covariance = np.zeros(ERROR_DIM), np.diag(self._unknown(now.time))
        self._window.append(_Epoch(now, solved, self.errors, prior, covariance))
        self._window = [one for one in self._window if now.time - one.record.time <= LAG]
        self._motion = _AT_REST
        self._judge(now.time, self._solve())

    def _wandered(self, dt: float) -> FloatArray:
        return self.settings.odometry.wandered(np.array([dt]))[:, 0]

    def _unknown(self, time: float) -> FloatArray:
        """Variances (3,) of the errors at a time, s, without any measurement."""
        return self.settings.odometry.slow**2 + self._wandered(time - self._start)

    def _solve(self) -> bool:
        """Solve the window and return whether that converged."""
        record, path, first = [one.record for one in self._window], [one.pose for one in self._window], self._window[0]
        graph, noise = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Gaussian.Covariance(first.prior_covariance)
        held = gtsam.noiseModel.Isotropic.Sigma(6, START_NOISE)
        graph.addPriorPose3(pose_key(first.record.epoch), gtsam.Pose3(first.pose), held)
        graph.push_back(gtsam.PriorFactorVector(error_key(first.record.epoch), first.prior, noise))
        values = gtsam.Values()
        for one in self._window:
            values.insert(pose_key(one.record.epoch), gtsam.Pose3(one.pose))
            values.insert(error_key(one.record.epoch), one.errors)
        deviations = np.sqrt(np.diagonal(self.covariance))
        stationary = stationary_probabilities(record, np.stack(path), deviations, self.settings)
        places, seen = _landmarks(record, path, stationary, self.settings)
        for key, place in places.items():
            values.insert(key, place)
        settings = SolverSettings(max_iterations=_ITERATIONS, tolerance=TOLERANCE)
        solution = solve(graph, [*odometry(record, self.settings), *seen], values, settings)
        self._window = [
            replace(
                one,
                pose=solution.values.atPose3(pose_key(one.record.epoch)).matrix(),
                errors=solution.values.atVector(error_key(one.record.epoch)),
            )
            for one in self._window
        ]
        self.errors = self._window[-1].errors
        self.covariance = solution.marginal(error_key(record[-1].epoch))
        return solution.converged

    def _judge(self, time: float, converged: bool) -> None:
        """Step aside, or come back."""
        prior = self._unknown(time)
        expected = np.maximum(prior - self.covariance.diagonal(), _LEAST_SHARE * prior)
        aside = not converged or bool((self.errors**2 / expected).sum() > LIMIT)
        if aside and not self.aside:
            errors = "scale {:.3f}, bias {:.4f} rad/s, course {:.3f} rad".format(*self.errors)
            log.warning("from %.3f s: odometry as it is, stationary objects contradict its noise: %s", time, errors)
        self.aside = aside


def _landmarks(
    record: Sequence[RecordedEpoch],
    path: Sequence[FloatArray],
    stationary: Sequence[FloatArray],
    settings: JointSettings,
) -> tuple[dict[int, FloatArray], list[ResidualFactors]]:
    """Places (2,) of stationary objects by key, and their detections; one that moved in between is another one."""
    began, places, rows = dict[int, int](), dict[int, FloatArray](), list[tuple[Any, ...]]()
    for now, pose, p in zip(record, path, stationary, strict=True):
        likely = p[np.searchsorted(now.objects.id, now.seen.id)] > LIKELY
        world = transform_points(pose, now.seen.z)[:, :2]
        for id_, is_stationary, z, R, place in zip(
            now.seen.id.tolist(), likely, now.seen.z, now.seen.R, world, strict=True
        ):
            if not is_stationary:
                began.pop(id_, None)
                continue
            key = object_key(began.setdefault(id_, now.epoch), id_)
            places.setdefault(key, place)
            rows.append(((pose_key(now.epoch), key), z, CORRELATED * R))
    if not rows:
        return places, []
    keys, seen, covariances = (np.array(column) for column in zip(*rows, strict=True))
    loss = detection_loss(settings)
    return places, [relative_factors(keys.astype(np.uint64), seen, covariances, 2, robust=loss)]

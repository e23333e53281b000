"""The vehicle's path frame by frame: odometry without the slow errors that stationary objects tell.

Over the last `LAG` seconds a graph has the poses, the slow errors of the odometry and the places of objects that are
stationary with `LIKELY` and more (`saga_fg.slam.joint.record`), whose detections count with `CORRELATED` times their
covariance: a detector errs alike from frame to frame. Moving objects are not in it. The first pose of the lag is held,
its errors have the estimate that they had when they were newest. The path goes on by increments without the errors, so
that it does not jump and tracks along it keep their velocities.

The estimate steps aside where it contradicts the odometry. With errors e ~ N(0, P0) by the device's noise, estimated
as m with the covariance P, m is N(0, P0 - P): where the sum of m_i^2 / (P0 - P)_ii exceeds `LIMIT`, 99 % of chi^2 with
three degrees of freedom, what seems to stand does not, or the detector is wrong, and the path goes on by the odometry
as it is. Where few objects stand, m is small and so is what it changes.
"""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from factors import ERROR_DIM, ResidualFactors, SolverSettings, relative_factors, solve
from saga_fg.numerics import FloatArray, checked_transform, transform_points
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
from saga_fg.slam.joint.record import EpochRecorder, JointSettings, RecordedEpoch, stationary_probabilities
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


class OnlinePath:
    """A tracker along the path that it mends, one frame after the other.

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
        self._recorder, self._start = EpochRecorder(tracker), math.inf
        self._window: list[_Epoch] = []

    def step(self, frame: Frame, a_T_b: FloatArray, covariance: FloatArray | None = None) -> Tracks:
        """Take in a frame, after a motion a_T_b (4, 4) since the one before, and return the tracks.

        a_T_b is the identity for the first frame; covariance: (6, 6) of it, as in `OdometryIncrements`. Raises
        `InputError` for a motion that is none, and for a frame that is not later than the last one, or in world
        coordinates without a pose.
        """
        a_T_b = checked_transform("a_T_b", a_T_b)
        number, solved, pose = 0, self.world_T_ego, self.world_T_ego
        if self._window:
            last = self._window[-1]
            mended = without_errors(a_T_b, self.errors, frame.timestamp - last.record.time)
            number, solved, pose = last.record.epoch + 1, last.pose @ mended, pose @ (a_T_b if self.aside else mended)
        now = self._recorder.add(number, frame, pose, a_T_b, covariance)
        self.world_T_ego, self._start = pose, min(self._start, now.time)
        self._window.append(_Epoch(now, solved, self.errors, self.errors, self.covariance))
        while now.time - self._window[0].record.time > LAG:
            del self._window[0]
        self._solve()
        self._judge(now.time)
        return self._recorder.tracks

    def _solve(self) -> None:
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

    def _judge(self, time: float) -> None:
        """Step aside, or come back."""
        noise = self.settings.odometry
        wandered = noise.covariances(np.zeros(1), np.array([time - self._start]))[0].diagonal()[-ERROR_DIM:]
        prior = noise.slow**2 + wandered
        expected = np.maximum(prior - self.covariance.diagonal(), _LEAST_SHARE * prior)
        aside = bool((self.errors**2 / expected).sum() > LIMIT)
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

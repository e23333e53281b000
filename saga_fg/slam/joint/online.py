"""Path, landmarks and objects online: the running graph of the last seconds, with a joint prior for all before.

Each frame adds an epoch to the window. The stationarity of objects follows from the window, the identity of detections
from the objects after it, and iSAM2 solves the window with the new factors. Epochs older than `lag` leave, and
landmarks last observed from them (`saga_fg.slam.joint.providers`). With a lag longer than the recording this is the
batch estimate, but for associations made online.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from saga_fg.errors import InputError
from saga_fg.estimators.solution import GraphSolution
from saga_fg.graph import FactorProvider
from saga_fg.numerics.arrays import FloatArray, checked_covariances
from saga_fg.numerics.geometry import checked_transform
from saga_fg.slam.joint.association import (
    NearestLandmarks,
    Observations,
    Seen,
    SlowErrors,
    stationary_probabilities,
    with_identities,
)
from saga_fg.slam.joint.batch import checked_landmarks
from saga_fg.slam.joint.graph import JointEstimate, read_estimate
from saga_fg.slam.joint.providers import Window
from saga_fg.slam.joint.record import EpochRecorder, JointSettings, OdometryIncrements, RecordedEpoch
from saga_fg.tracking import Tracker
from saga_fg.types.frame import Frame

_DOUBTFUL = 0.9  # probability of an assignment below which its detection is weighed anew


@dataclass(frozen=True, eq=False)
class OnlineStep:
    """newest: the estimate of the new epoch; settled: of those that left the window with it, oldest first."""

    newest: JointEstimate
    settled: JointEstimate | None


class OnlineEstimator:
    """Estimate one frame after the other.

        estimator = OnlineEstimator(Tracker(...), lag=3.0)
        step = estimator.step(frame, a_T_b)
        step.newest.world_T_ego[-1], step.newest.objects[-1]

    tracker    a new one, which associates detections
    lag        s; the window begins at the last epoch that is at least so old
    settings   of the graph
    start      first pose (4, 4), by default the identity
    providers  of factors of your own, asked with each frame after its vehicle and objects are added

    Raises `InputError` for a negative lag, and a first pose that is not rigid.
    """

    def __init__(
        self,
        tracker: Tracker,
        lag: float,
        settings: JointSettings | None = None,
        start: FloatArray | None = None,
        providers: Sequence[FactorProvider] = (),
    ) -> None:
        if not (math.isfinite(lag) and lag >= 0):
            raise InputError(f"lag: expected a finite number of seconds >= 0, got {lag!r}")
        self._lag, self._settings = lag, settings or JointSettings()
        self._recorder = EpochRecorder(tracker)
        self._start = np.eye(4) if start is None else checked_transform("start", start)
        self._window = Window(self._settings, providers)
        self._clutter_area = tracker.settings.association.clutter_area
        self._landmarks = NearestLandmarks()
        self._stationary: list[FloatArray] = []
        self._slow = SlowErrors.at_start(self._settings)
        self._solution: GraphSolution | None = None

    def step(
        self,
        frame: Frame,
        a_T_b: FloatArray | None = None,
        covariance: FloatArray | None = None,
        observations: Sequence[Seen] = (),
    ) -> OnlineStep:
        """Add the next frame, after the vehicle moved by a_T_b (4, 4) since the last one by its odometry.

        a_T_b: not needed for the first frame; covariance: (6, 6) of it as in `OdometryIncrements`, if the device states
        one; observations: of landmarks, from the new pose, all with their numbers or none. Raises `InputError` for a
        motion that is missing or not rigid, a bad covariance, a frame that is not later than the last one, or in world
        coordinates without a pose.
        """
        window = self._window
        if not window.record:
            pose, increment, covariance = self._start, np.eye(4), None
        elif a_T_b is None:
            raise InputError("a_T_b: expected the motion since the last frame")
        else:
            increment = checked_transform("a_T_b", a_T_b)
            covariance = None if covariance is None else checked_covariances("covariance", [covariance], 1, 6)[0]
            pose = window.predicted(frame.timestamp, increment)
        number = window.record[-1].epoch + 1 if window.record else 0
        now = self._recorder.add(number, frame, pose, increment, covariance)
        before = [] if not window.record else list(window.path)
        self._stationary = self._probabilities([*window.record, now], np.stack([*before, pose]))
        solution = window.add(now, frame, pose, self._stationary)
        more: list[FactorProvider] = []
        if observations:
            more.append(self._landmarks.observe(number, window.pose(number), observations))
        newest = read_estimate(window.record[-1:], solution, self._stationary[-1:])
        doubtful = with_identities(now, newest.world_T_ego[-1], newest.objects[-1].position, self._clutter_area)
        if (doubtful.seen.probability < _DOUBTFUL).any():
            more.append(window.weighed(doubtful))
        if more:
            self._stationary = self._probabilities(window.record, window.path)
            solution = window.extend(self._stationary, more)
        self._solution = solution
        settled = self._slide(solution)
        newest = read_estimate(window.record[-1:], solution, self._stationary[-1:])
        self._slow = newest.slow_errors
        return OnlineStep(newest, settled)

    def window(self) -> JointEstimate:
        """The estimate of all epochs in the window. Raises `InputError` before the first frame."""
        if self._solution is None:
            raise InputError("expected a frame before the estimate is asked for")
        return read_estimate(self._window.record, self._solution, self._stationary)

    def _probabilities(self, record: Sequence[RecordedEpoch], path: FloatArray) -> list[FloatArray]:
        """For each epoch the probabilities that its objects are stationary, along a path (n, 4, 4)."""
        return stationary_probabilities(record, path, self._slow, self._settings, online=True)

    def _slide(self, solution: GraphSolution) -> JointEstimate | None:
        """Let epochs leave that are older than the lag; returns their estimate."""
        window = self._window
        count = window.older_than(window.record[-1].time - self._lag)
        if not count:
            return None
        settled = read_estimate(window.record[:count], solution, self._stationary[:count])
        first = window.record[count].epoch
        self._stationary = self._stationary[count:]
        window.leave(count, self._landmarks.forget(first))
        return settled


@dataclass(frozen=True, eq=False)
class OnlineEstimate:
    """Poses (n, 4, 4) of n epochs, world_T_ego.

    newest       estimated when the frame came, covariances (n, 6, 6) in its own frame: rotation vector (rad),
                 translation (m)
    settled      estimated when the epoch left the window, or at the end
    """

    timestamps: FloatArray
    newest: FloatArray
    covariances: FloatArray
    settled: FloatArray


def estimate_online(
    frames: Sequence[Frame],
    odometry: OdometryIncrements,
    estimator: OnlineEstimator,
    landmarks: Observations | None = None,
) -> OnlineEstimate:
    """Feed n frames to a new estimator; landmarks: observations at each epoch.

    Raises `InputError` where frames, odometry and landmarks do not fit together.
    """
    landmarks = checked_landmarks(frames, odometry, landmarks)
    newest, covariances, settled = [], [], []
    for k, frame in enumerate(frames):
        increment = odometry.a_T_b[k - 1] if k else None
        covariance = odometry.covariances[k - 1] if k and odometry.covariances is not None else None
        step = estimator.step(frame, increment, covariance, landmarks[k])
        newest.append(step.newest.world_T_ego[-1])
        covariances.append(step.newest.pose_covariances[-1])
        if step.settled is not None:
            settled.append(step.settled.world_T_ego)
    settled.append(estimator.window().world_T_ego)
    return OnlineEstimate(
        odometry.timestamps,
        np.stack(newest),
        np.stack(covariances),
        np.concatenate(settled),
    )

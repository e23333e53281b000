"""Path and objects online: the running graph of the last seconds, with a joint prior for all before.

Each frame adds an epoch to the window. The stationarity of objects follows from the window, the identity of detections
from the objects after it, and iSAM2 solves the window with the new factors. Epochs older than `lag` leave: they are
marginalised with all factors on their variables, linearised at the present estimate.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from saga_fg.errors import InputError
from saga_fg.estimators.incremental_smoother import IncrementalSmoother
from saga_fg.estimators.isam2_engine import RelinearisationSettings
from saga_fg.graph import Additions, FactorProvider, GraphError
from saga_fg.numerics.arrays import FloatArray, checked_covariances
from saga_fg.numerics.geometry import checked_transform, yaw_transform
from saga_fg.slam.joint.association import SlowErrors, stationary_probabilities, with_identities
from saga_fg.slam.joint.graph import JointEstimate, detections, error_key, read_estimate
from saga_fg.slam.joint.providers import StationaryPairs, VehicleAndObjects, detections_name
from saga_fg.slam.joint.record import MAX_ITERATIONS, EpochRecorder, JointSettings, RecordedEpoch
from saga_fg.slam.mapping import Given, pose_key
from saga_fg.tracking import Tracker
from saga_fg.types.frame import Frame

_DOUBTFUL = 0.9  # probability of an assignment below which its detection is weighed anew
_THRESHOLD = 0.1  # standard deviations that a variable moves before its factors are linearised anew


class OnlineEstimator:
    """Estimate one frame after the other.

        estimator = OnlineEstimator(Tracker(...), lag=3.0)
        newest = estimator.step(frame, a_T_b)
        newest.world_T_ego[-1], newest.objects[-1]

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
        self._settings, self._lag = settings or JointSettings(), lag
        self._smoother = IncrementalSmoother(providers, lag, RelinearisationSettings(_THRESHOLD, MAX_ITERATIONS))
        self._recorder, self._clutter_area = EpochRecorder(tracker), tracker.settings.association.clutter_area
        self._start = np.eye(4) if start is None else checked_transform("start", start)
        self._slow = SlowErrors.at_start(self._settings)
        self._pairs, self._stationary = StationaryPairs(), list[FloatArray]()
        self._record = list[RecordedEpoch]()  # of the window

    def step(
        self, frame: Frame, a_T_b: FloatArray | None = None, covariance: FloatArray | None = None
    ) -> JointEstimate:
        """Add the next frame, after the vehicle moved by a_T_b (4, 4) since the last one by its odometry; its estimate.

        a_T_b: not needed for the first frame; covariance: (6, 6) of it as in `OdometryIncrements`, if the device states
        one. Raises `InputError` for a motion that is missing or not rigid, a bad covariance, a frame that is not later
        than the last one, or in world coordinates without a pose.
        """
        if not self._record:
            pose, increment, covariance = self._start, np.eye(4), None
        elif a_T_b is None:
            raise InputError("a_T_b: expected the motion since the last frame")
        else:
            increment = checked_transform("a_T_b", a_T_b)
            covariance = None if covariance is None else checked_covariances("covariance", [covariance], 1, 6)[0]
            pose = self._predicted(frame.timestamp, increment)
        number = self._record[-1].epoch + 1 if self._record else 0
        now = self._recorder.add(number, frame, pose, increment, covariance)
        record = [*self._record, now]
        self._stationary = self._probabilities(record, [*map(self._pose, self._record), pose])
        new = VehicleAndObjects(record[-2:], [pose], self._settings, known=len(record[-2:]) - 1)
        given = self._pairs.changed(record, self._stationary)
        try:
            self._smoother.step(now.time, [new, given, *self._smoother.providers], frame)
        except GraphError:
            self._pairs = StationaryPairs()  # whose factors are unknown now
            raise
        gone = sum(one.time <= now.time - self._lag for one in record[1:])
        self._record, self._stationary = record[gone:], self._stationary[gone:]
        newest = self._estimate(1)
        doubtful = with_identities(now, newest.world_T_ego[-1], newest.objects[-1].position, self._clutter_area)
        if (doubtful.seen.probability < _DOUBTFUL).any():
            newest = self._weighed(doubtful)
        self._slow = newest.slow_errors
        return newest

    def window(self) -> JointEstimate:
        """The estimate of all epochs in the window. Raises `InputError` before the first frame."""
        if not self._record:
            raise InputError("expected a frame before the estimate is asked for")
        return self._estimate(len(self._record))

    def _weighed(self, now: RecordedEpoch) -> JointEstimate:
        """The newest epoch with other probabilities of its detections, solved again."""
        self._record[-1] = now
        weighed = Given(
            Additions(named={detections_name(now): detections([now], self._settings)}), VehicleAndObjects.name
        )
        self._stationary = self._probabilities(self._record, list(map(self._pose, self._record)))
        self._smoother.extend([weighed, self._pairs.changed(self._record, self._stationary)])
        return self._estimate(1)

    def _estimate(self, count: int) -> JointEstimate:
        """The estimate of the newest epochs."""
        return read_estimate(self._record[-count:], self._smoother.solution(), self._stationary[-count:])

    def _probabilities(self, record: Sequence[RecordedEpoch], path: Sequence[FloatArray]) -> list[FloatArray]:
        """For each epoch the probabilities that its objects are stationary, along a path (n, 4, 4)."""
        return stationary_probabilities(record, np.stack(path), self._slow, self._settings, online=True)

    def _pose(self, epoch: RecordedEpoch) -> FloatArray:
        pose = self._smoother.state(pose_key(epoch.epoch))
        assert isinstance(pose, gtsam.Pose3)
        return pose.matrix()

    def _predicted(self, time: float, a_T_b: FloatArray) -> FloatArray:
        """The pose (4, 4) after the motion a_T_b, corrected by the estimated errors of the odometry."""
        last = self._record[-1]
        scale, bias, course = np.asarray(self._smoother.state(error_key(last.epoch)))
        step = yaw_transform(yaw=-bias * (time - last.time)) @ a_T_b
        step[:3, 3] = yaw_transform(yaw=-course)[:3, :3] @ a_T_b[:3, 3] / (1 + scale)
        return np.asarray(self._pose(last) @ step)

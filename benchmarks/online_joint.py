"""The vehicle's path and the objects around it online: what `benchmarks joint --online` measures.

Each frame adds an epoch to the running graph of the last seconds. The stationarity of objects follows from the window,
and iSAM2 solves that with the new factors. Epochs older than `lag` leave: they are marginalised with all factors on
their variables, linearised at the present estimate. On recordings it pays neither for the path nor for the objects
beside a tracker along LiDAR odometry, so that no command offers it.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from itertools import pairwise

import gtsam
import numpy as np

from saga_fg.errors import InputError
from saga_fg.estimators import GraphSolution, IncrementalSmoother, RelinearisationSettings
from saga_fg.graph import Additions, FactorProvider, Factors, GraphError
from saga_fg.numerics import FloatArray, checked_covariances, checked_transform, yaw_transform
from saga_fg.slam.joint.association import SlowErrors, stationary_probabilities
from saga_fg.slam.joint.graph import (
    JointEstimate,
    Record,
    VehicleAndObjects,
    error_key,
    read_estimate,
    stationary_factors,
)
from saga_fg.slam.joint.record import MAX_ITERATIONS, EpochRecorder, JointSettings, RecordedEpoch
from saga_fg.slam.mapping import Given, pose_key
from saga_fg.tracking import Tracker
from saga_fg.types import Frame

_SAME = 1e-3  # probability


class StationaryPairs:
    """Factors of stationary objects for every two epochs, given anew where the probabilities have changed."""

    name = "stationary objects"

    def __init__(self) -> None:
        self._given: dict[int, tuple[FloatArray, FloatArray]] = {}

    def changed(self, record: Record, stationary: Sequence[FloatArray]) -> Given:
        """Return the provider of a window, with the probabilities (n,) of the objects of each epoch."""
        named: dict[Hashable, Factors] = {}
        given: dict[int, tuple[FloatArray, FloatArray]] = {}
        for pair, rows in zip(pairwise(stationary), pairwise(record), strict=True):
            k, before = rows[1].epoch, self._given.get(rows[1].epoch)
            if before is None or not all(np.allclose(a, b, atol=_SAME) for a, b in zip(before, pair, strict=True)):
                named[k], before = stationary_factors(rows, pair), pair
            given[k] = before
        self._given = given
        return Given(Additions(named=named), self.name)


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
        if not (math.isfinite(lag) and lag >= 0):
            raise InputError(f"lag: expected a finite number of seconds >= 0, got {lag!r}")
        self._settings, self._lag = settings or JointSettings(), lag
        # without a lag of its own: epochs leave here, and elimination in the order of time would cost thrice as much
        self._smoother = IncrementalSmoother(providers, None, RelinearisationSettings(_THRESHOLD, MAX_ITERATIONS))
        self._recorder = EpochRecorder(tracker)
        self._start = np.eye(4) if start is None else checked_transform("start", start)
        self._slow = SlowErrors.at_start(self._settings)
        self._pairs, self._stationary = StationaryPairs(), list[FloatArray]()
        self._record = list[RecordedEpoch]()  # of the window
        self._solution: GraphSolution | None = None

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
        self._record, self._solution = record, self._smoother.solution()
        newest = self._estimate(1)
        since = now.time - self._lag
        gone = sum(one.time <= since for one in record[1:])
        self._smoother.forget(since=since)
        self._record, self._stationary = self._record[gone:], self._stationary[gone:]
        self._slow = newest.slow_errors
        return newest

    def window(self) -> JointEstimate:
        """The estimate of all epochs in the window. Raises `InputError` before the first frame."""
        if not self._record:
            raise InputError("expected a frame before the estimate is asked for")
        return self._estimate(len(self._record))

    def _estimate(self, count: int) -> JointEstimate:
        """The estimate of the newest epochs by the last solution, which has the epochs that left after it, too."""
        assert self._solution is not None
        return read_estimate(self._record[-count:], self._solution, self._stationary[-count:])

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

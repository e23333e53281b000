"""Window of the joint estimation: its last epochs as a running graph that iSAM2 solves (`saga_fg.graph`).

Epochs that leave are marginalised with all factors on their variables, linearised at the present estimate. Linear
Gaussian factors stay exact; others keep their linearisation.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from saga_fg.estimators.graph_solution import GraphSolution
from saga_fg.estimators.incremental_smoother import IncrementalSmoother
from saga_fg.estimators.isam2_engine import RelinearisationSettings
from saga_fg.graph import FactorProvider, GraphError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.slam.joint.graph import error_key
from saga_fg.slam.joint.providers import Detections, StationaryPairs, VehicleAndObjects
from saga_fg.slam.joint.record import RecordedEpoch
from saga_fg.slam.joint.settings import MAX_ITERATIONS, JointSettings
from saga_fg.slam.mapping import pose_key
from saga_fg.types.frame import Frame

_THRESHOLD = 0.1  # standard deviations that a variable moves before its factors are linearised anew


class Window:
    """The epochs of `record` in a running graph; providers: others that are asked at every epoch."""

    def __init__(self, settings: JointSettings, providers: Sequence[FactorProvider] = ()) -> None:
        relinearisation = RelinearisationSettings(_THRESHOLD, MAX_ITERATIONS)
        self._settings, self._smoother = settings, IncrementalSmoother(providers, None, relinearisation)
        self._stationary = StationaryPairs()
        self.record: list[RecordedEpoch] = []

    @property
    def path(self) -> FloatArray:
        """The poses (n, 4, 4)."""
        return np.stack([self.pose(now.epoch) for now in self.record])

    def pose(self, epoch: int) -> FloatArray:
        """The pose (4, 4) of an epoch."""
        pose = self._smoother.state(pose_key(epoch))
        assert isinstance(pose, gtsam.Pose3)
        return pose.matrix()

    def predicted(self, time: float, a_T_b: FloatArray) -> FloatArray:
        """The pose (4, 4) after the motion a_T_b, corrected by the estimated errors of the odometry."""
        last = self.record[-1]
        scale, bias, course = np.asarray(self._smoother.state(error_key(last.epoch)))
        step = yaw_transform(yaw=-bias * (time - last.time)) @ a_T_b
        step[:3, 3] = yaw_transform(yaw=-course)[:3, :3] @ a_T_b[:3, 3] / (1 + scale)
        return np.asarray(self.pose(last.epoch) @ step)

    def add(
        self, now: RecordedEpoch, frame: Frame, pose: FloatArray, stationary: Sequence[FloatArray]
    ) -> GraphSolution:
        """Add an epoch, whose expected pose is given, and solve; stationary: probabilities, of the new epoch too.

        frame: of the epoch, for the providers
        """
        record = [*self.record, now]
        new = VehicleAndObjects(record[-2:], [pose], self._settings, known=len(record[-2:]) - 1)
        given = self._stationary.with_probabilities(record, stationary)
        try:
            self._smoother.step(now.time, [new, given, *self._smoother.providers], frame)
        except GraphError:
            self._stationary = StationaryPairs()  # whose factors are unknown now
            raise
        self.record = record
        return self._smoother.solution()

    def extend(self, stationary: Sequence[FloatArray], providers: Sequence[FactorProvider]) -> GraphSolution:
        """Add factors of providers at the newest epoch, replace those of stationary objects, and solve."""
        self._smoother.extend([*providers, self._stationary.with_probabilities(self.record, stationary)])
        return self._smoother.solution()

    def weighed(self, now: RecordedEpoch) -> Detections:
        """The detections of the newest epoch with other probabilities, as a provider for `extend`."""
        self.record[-1] = now
        return Detections(now, self._settings)

    def older_than(self, time: float) -> int:
        """Number of epochs that may leave so that one at `time` or before still stays, if there is one."""
        return sum(now.time <= time for now in self.record[1:])

    def leave(self, count: int, others: Iterable[int]) -> None:
        """Marginalise the first epochs, and other variables without factors in the rest of the window."""
        leaving, self.record = {now.epoch for now in self.record[:count]}, self.record[count:]
        variables = self._smoother.graph().variables.values()
        self._smoother.marginalise({*others, *(one.key for one in variables if one.epoch in leaving)})

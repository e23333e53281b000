"""The last moments of the joint graph, as a running graph that iSAM2 solves (`saga_fg.graph`).

Moments that leave are marginalised with all factors that speak of them, linearised where they are, so that nothing they
knew of the rest is lost. What was linear and Gaussian stays exact; what was not keeps the linearisation of the moment
at which it left.
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
from saga_fg.slam.joint.graph import Keyed, error_key, object_key
from saga_fg.slam.joint.providers import Moments, Standing
from saga_fg.slam.joint.record import EgoMoment
from saga_fg.slam.joint.settings import JointSettings
from saga_fg.slam.mapping import pose_key

_THRESHOLD = 0.1  # standard deviations that a variable moves before its factors are linearised anew


class Window:
    """Moments with their keys, `record`, in a running graph; providers: others that are asked at every moment."""

    def __init__(self, settings: JointSettings, providers: Sequence[FactorProvider] = ()) -> None:
        relinearisation = RelinearisationSettings(_THRESHOLD, settings.max_iterations)
        self._settings, self._smoother = settings, IncrementalSmoother(providers, None, relinearisation)
        self._standing = Standing(settings)
        self.record: Keyed = []

    @property
    def path(self) -> FloatArray:
        """The poses (n, 4, 4)."""
        return np.stack([self.pose(k) for k, _ in self.record])

    def pose(self, moment: int) -> FloatArray:
        """The pose (4, 4) of a moment."""
        pose = self._smoother.state(pose_key(moment))
        assert isinstance(pose, gtsam.Pose3)
        return pose.matrix()

    def predicted(self, time: float, a_T_b: FloatArray) -> FloatArray:
        """The pose (4, 4) after the motion a_T_b, the errors that the odometry is known to have taken out."""
        k, last = self.record[-1]
        scale, bias, course = np.asarray(self._smoother.state(error_key(k)))
        step = yaw_transform(yaw=-bias * (time - last.time)) @ a_T_b
        step[:3, 3] = yaw_transform(yaw=-course)[:3, :3] @ a_T_b[:3, 3] / (1 + scale)
        return np.asarray(self.pose(k) @ step)

    def add(self, moment: EgoMoment, pose: FloatArray, standing: Sequence[FloatArray]) -> GraphSolution:
        """Add a moment, whose pose is expected there, and solve; standing: probabilities, of the new moment too."""
        record = [*self.record, (self.record[-1][0] + 1 if self.record else 0, moment)]
        new = Moments(record[-2:], [pose], self._settings, known=len(record[-2:]) - 1)
        given = self._standing.with_probabilities(record, standing)
        try:
            self._smoother.step(moment.time, [new, given, *self._smoother.providers])
        except GraphError:
            self._standing = Standing(self._settings)  # it does not know what has become of its factors
            raise
        self.record = record
        return self._smoother.solution()

    def extend(self, standing: Sequence[FloatArray], providers: Sequence[FactorProvider]) -> GraphSolution:
        """Ask for more factors at the newest moment, judge anew who stands, and solve."""
        self._smoother.extend([*providers, self._standing.with_probabilities(self.record, standing)])
        return self._smoother.solution()

    def older_than(self, time: float) -> int:
        """How many moments may leave so that one at `time` or before still stays, if there is one."""
        return sum(moment.time <= time for _, moment in self.record[1:])

    def leave(self, count: int, others: Iterable[int]) -> None:
        """Let the first moments leave, and other variables that nobody in the rest of the window speaks of."""
        leaving, self.record = self.record[:count], self.record[count:]
        self._smoother.marginalise({*others, *(key for k, moment in leaving for key in _keys(k, moment))})


def _keys(k: int, moment: EgoMoment) -> list[int]:
    """The variables of a moment."""
    return [pose_key(k), error_key(k), *(object_key(k, name) for name in moment.objects.id.tolist())]

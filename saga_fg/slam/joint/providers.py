"""Factor providers of the joint estimation, for a whole recording or a window of epochs.

Window of the joint estimation: its last epochs as a running graph that iSAM2 solves (`saga_fg.graph`).

Epochs that leave are marginalised with all factors on their variables, linearised at the present estimate. Linear
Gaussian factors stay exact; others keep their linearisation.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np

from factors import ERROR_DIM
from saga_fg.estimators.incremental_smoother import IncrementalSmoother
from saga_fg.estimators.isam2_engine import RelinearisationSettings
from saga_fg.estimators.solution import GraphSolution
from saga_fg.graph import EGO_ERROR, EGO_POSE, OBJECT, Additions, FactorProvider, GraphError, GraphView, NewVariable
from saga_fg.graph.factor_checks import Factor
from saga_fg.graph.providers import Factors
from saga_fg.model.interactions import POSITION, VELOCITY
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import transform_points, yaw_transform
from saga_fg.slam.joint.graph import (
    Record,
    detections,
    error_key,
    motion_factors,
    new_object_factors,
    new_streams,
    object_key,
    odometry,
    start_factors,
    stationary_factors,
)
from saga_fg.slam.joint.record import MAX_ITERATIONS, JointSettings, RecordedEpoch
from saga_fg.slam.mapping import Given, pose_key
from saga_fg.types.frame import Frame

_SAME = 1e-3  # probability


@dataclass(frozen=True, eq=False)
class VehicleAndObjects:
    """Add the epochs of `record`, one a frame, of which the graph has the first `known` already.

    path: expected poses (4, 4) of the others. Odometry and detections come with the last epoch, so that all are
    linearised together.
    """

    record: Record
    path: Sequence[FloatArray] | FloatArray
    settings: JointSettings
    known: int = 0
    name: str = "vehicle and objects"

    def factors(self, view: GraphView) -> Additions:
        row = view.epoch - self.record[0].epoch
        now, pose, k = self.record[row], self.path[row - self.known], view.epoch
        before = set(self.record[row - 1].objects.id.tolist()) if row else set()
        slow = view.state(error_key(k - 1)) if k else np.zeros(ERROR_DIM)
        new = [NewVariable(EGO_POSE, 0, gtsam.Pose3(pose), label="vehicle"), NewVariable(EGO_ERROR, 0, slow)]
        seen = dict(zip(now.seen.id.tolist(), transform_points(pose, now.seen.z)[:, :2], strict=True))
        objects = now.objects
        for name, kind, label in zip(objects.id.tolist(), objects.types, objects.label, strict=True):
            state = np.zeros(kind.dim)
            if name in before:  # at constant velocity
                state = np.array(view.state(object_key(k - 1, name)))
                state[kind.index(POSITION)] += view.dt * state[kind.index(VELOCITY)]
            if name in seen:
                state[kind.index(POSITION)] = seen[name]
            new.append(NewVariable(OBJECT, name, state, label=label))
        factors: list[Factor] = [*new_object_factors(now, before)]
        named: dict[Hashable, Factors] = {}
        if before:
            new += new_streams(now)
            factors += motion_factors(now)
        if k == 0:
            factors += start_factors(k, pose, self.settings)
        if row + 1 == len(self.record):
            factors += odometry(self.record[max(self.known - 1, 0) :], self.settings)
            named[detections_name(now)] = detections(self.record[self.known :], self.settings)
        return Additions(new, factors, named=named)


def detections_name(now: RecordedEpoch) -> Hashable:
    """Name of the detections up to an epoch among the factors of `VehicleAndObjects`."""
    return ("detections", now.epoch)


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
        given = self._stationary.changed(record, stationary)
        try:
            self._smoother.step(now.time, [new, given, *self._smoother.providers], frame)
        except GraphError:
            self._stationary = StationaryPairs()  # whose factors are unknown now
            raise
        self.record = record
        return self._smoother.solution()

    def extend(self, stationary: Sequence[FloatArray], providers: Sequence[FactorProvider]) -> GraphSolution:
        """Add factors of providers at the newest epoch, replace those of stationary objects, and solve."""
        self._smoother.extend([*providers, self._stationary.changed(self.record, stationary)])
        return self._smoother.solution()

    def weighed(self, now: RecordedEpoch) -> Given:
        """The detections of the newest epoch with other probabilities, as a provider for `extend`."""
        self.record[-1] = now
        named = {detections_name(now): detections([now], self._settings)}
        return Given(Additions(named=named), VehicleAndObjects.name)

    def older_than(self, time: float) -> int:
        """Number of epochs that may leave so that one at `time` or before still stays, if there is one."""
        return sum(now.time <= time for now in self.record[1:])

    def leave(self, count: int, others: Iterable[int]) -> None:
        """Marginalise the first epochs, and other variables without factors in the rest of the window."""
        leaving, self.record = {now.epoch for now in self.record[:count]}, self.record[count:]
        variables = self._smoother.graph().variables.values()
        self._smoother.marginalise({*others, *(one.key for one in variables if one.epoch in leaving)})

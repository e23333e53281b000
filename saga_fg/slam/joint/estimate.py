"""Result of the joint estimation, read from the solved graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from factors import Solution
from saga_fg.estimators.graph_solution import GraphSolution
from saga_fg.model.interactions import POSITION, VELOCITY
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.assignment import Assignment
from saga_fg.slam.joint.graph import Record, error_key, object_key
from saga_fg.slam.joint.record import RecordedEpoch
from saga_fg.slam.joint.stationarity import SlowErrors
from saga_fg.slam.mapping import LandmarkObservations, pose_key
from saga_fg.types.landmark import Landmark


@dataclass(frozen=True, eq=False)
class ObjectStates:
    """Objects of an epoch: id (n,), n classes, position (n, 2), m, and velocity (n, 2), m/s, in the world.

    stationary  (n,) probability of being at rest
    """

    id: IntArray
    label: tuple[str, ...]
    position: FloatArray
    velocity: FloatArray
    stationary: FloatArray


@dataclass(frozen=True, eq=False)
class JointEstimate:
    """Estimate at n epochs.

    timestamps    (n,) s
    world_T_ego   (n, 4, 4)
    errors        (n, 3) of the odometry: scale, bias of the yaw rate (rad/s), course (rad)
    objects       n tables
    converged     whether the last step was short enough
    solution      of the graph, with the keys of `saga_fg.slam.joint.graph`
    observations  of landmarks, associated along the path
    """

    timestamps: FloatArray
    world_T_ego: FloatArray
    errors: FloatArray
    objects: tuple[ObjectStates, ...]
    converged: bool
    solution: Solution | GraphSolution
    _record: Record
    observations: LandmarkObservations | None = None

    @cached_property
    def pose_covariances(self) -> FloatArray:
        """(n, 6, 6) of each pose, in its own frame: rotation vector (rad), translation (m)."""
        return np.stack([self.solution.marginal(pose_key(now.epoch)) for now in self._record])

    def object_covariances(self, row: int) -> FloatArray:
        """(n, 4, 4) of position and velocity of the objects of a row of the estimate."""
        now = self._record[row]
        result = np.empty((len(now.objects.id), 4, 4))
        for k, (name, node_type) in enumerate(zip(now.objects.id.tolist(), now.objects.types, strict=True)):
            at = node_type.index(POSITION + VELOCITY)
            result[k] = self.solution.marginal(object_key(now.epoch, name))[at[:, None], at]
        return result

    def assignment(self, row: int) -> Assignment:
        """Objects and their detections at a row of the estimate."""
        seen = self._record[row].seen
        return Assignment(seen.id, seen.row)

    @cached_property
    def landmarks(self) -> list[Landmark]:
        """Landmarks that were associated along the path."""
        return [] if self.observations is None else self.observations.landmarks(self.solution)

    @cached_property
    def slow_errors(self) -> SlowErrors:
        """Deviations of the odometry's slow errors: mean over the first, the middle and the last epoch."""
        n = len(self._record)
        P = np.stack([self.solution.marginal(error_key(self._record[row].epoch)) for row in (0, n // 2, n - 1)])
        return SlowErrors(*np.sqrt(np.diagonal(P, axis1=1, axis2=2).mean(axis=0)).tolist())


def read_estimate(
    record: Record, solution: Solution | GraphSolution, stationary: Sequence[FloatArray]
) -> JointEstimate:
    """The estimate at the epochs of a record; stationary: probabilities (n,) of the objects of each."""
    values = solution.values
    return JointEstimate(
        timestamps=np.array([now.time for now in record]),
        world_T_ego=np.stack([values.atPose3(pose_key(now.epoch)).matrix() for now in record]),
        errors=np.stack([values.atVector(error_key(now.epoch)) for now in record]),
        objects=tuple(_objects(now, values, p) for now, p in zip(record, stationary, strict=True)),
        converged=solution.converged,
        solution=solution,
        _record=record,
    )


def _objects(now: RecordedEpoch, values: gtsam.Values, stationary: FloatArray) -> ObjectStates:
    objects = now.objects
    state = np.zeros((len(objects.id), 4))
    for row, (name, node_type) in enumerate(zip(objects.id.tolist(), objects.types, strict=True)):
        state[row] = values.atVector(object_key(now.epoch, name))[node_type.index(POSITION + VELOCITY)]
    return ObjectStates(objects.id, objects.label, state[:, :2], state[:, 2:], stationary)

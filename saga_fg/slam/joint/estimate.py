"""What the joint estimation finds, read from the solved graph."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from factors import Solution
from saga_fg.estimators.graph_solution import GraphSolution
from saga_fg.model.interactions import POSITION, VELOCITY
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.slam.joint.graph import Keyed, error_key, object_key
from saga_fg.slam.joint.record import EgoMoment
from saga_fg.slam.joint.standing import SlowErrors
from saga_fg.slam.mapping import LandmarkObservations, pose_key
from saga_fg.types.landmark import Landmark


@dataclass(frozen=True, eq=False)
class ObjectStates:
    """Objects of a moment: id (n,), n classes, position (n, 2), m, and velocity (n, 2), m/s, in the world."""

    id: IntArray
    label: tuple[str, ...]
    position: FloatArray
    velocity: FloatArray


@dataclass(frozen=True, eq=False)
class JointEstimate:
    """Estimate at n moments.

    timestamps    (n,) s
    world_T_ego   (n, 4, 4)
    errors        (n, 3) of the odometry: scale, bias of the yaw rate (rad/s), course (rad)
    objects       n tables
    converged     whether the last step was short enough
    solution      of the graph, with the keys of `saga_fg.slam.joint.graph`
    observations     of landmarks, told apart by nobody else
    """

    timestamps: FloatArray
    world_T_ego: FloatArray
    errors: FloatArray
    objects: tuple[ObjectStates, ...]
    converged: bool
    solution: Solution | GraphSolution
    _record: Keyed
    observations: LandmarkObservations | None = None

    @cached_property
    def pose_covariances(self) -> FloatArray:
        """(n, 6, 6) of each pose, in its own frame: rotation vector (rad), translation (m)."""
        return np.stack([self._covariance(pose_key(k)) for k, _ in self._record])

    def object_covariances(self, moment: int) -> FloatArray:
        """(n, 4, 4) of position and velocity of the objects of a moment."""
        k, told = self._record[moment]
        result = np.empty((len(told.objects.id), 4, 4))
        for row, (name, node_type) in enumerate(zip(told.objects.id.tolist(), told.objects.types, strict=True)):
            at = node_type.index(POSITION + VELOCITY)
            result[row] = self._covariance(object_key(k, name))[at[:, None], at]
        return result

    @cached_property
    def landmarks(self) -> list[Landmark]:
        """Those that were told apart along the path."""
        return [] if self.observations is None else self.observations.landmarks(self.solution)

    @cached_property
    def slow_errors(self) -> SlowErrors:
        """How well the odometry's slow errors are known: at the first, the middle and the last moment, on average."""
        n = len(self._record)
        P = np.stack([self._covariance(error_key(self._record[row][0])) for row in (0, n // 2, n - 1)])
        return SlowErrors(*np.sqrt(np.diagonal(P, axis1=1, axis2=2).mean(axis=0)).tolist())

    def _covariance(self, key: int) -> FloatArray:
        return self.solution.marginal(key)


def read_estimate(record: Keyed, solution: Solution | GraphSolution) -> JointEstimate:
    """The estimate at the moments of a record."""
    values = solution.values
    return JointEstimate(
        timestamps=np.array([moment.time for _, moment in record]),
        world_T_ego=np.stack([values.atPose3(pose_key(k)).matrix() for k, _ in record]),
        errors=np.stack([values.atVector(error_key(k)) for k, _ in record]),
        objects=tuple(read_objects(k, moment, values) for k, moment in record),
        converged=solution.converged,
        solution=solution,
        _record=record,
    )


def read_objects(k: int, moment: EgoMoment, values: gtsam.Values) -> ObjectStates:
    """The objects of a moment."""
    objects = moment.objects
    state = np.zeros((len(objects.id), 4))
    for row, (name, node_type) in enumerate(zip(objects.id.tolist(), objects.types, strict=True)):
        state[row] = values.atVector(object_key(k, name))[node_type.index(POSITION + VELOCITY)]
    return ObjectStates(objects.id, objects.label, state[:, :2], state[:, 2:])

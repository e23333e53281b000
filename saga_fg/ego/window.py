"""The last moments of the joint graph, and a joint prior for all before.

Moments that leave are marginalised with all factors that speak of them, linearised where they are,

    phi(x_b) = max over x_a of prod phi(x_a, x_b),      a: what leaves, b: its neighbours that stay

so that nothing they knew of the rest is lost. What was linear and Gaussian stays exact; what was not keeps the
linearisation of the moment at which it left.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from factors import ERROR_DIM, Linearisable, Solution, SolverSettings, marginal_factors, nonlinear_graph_at, solve
from saga_fg.arrays import FloatArray
from saga_fg.ego.batch import TOLERANCE
from saga_fg.ego.graph import (
    Keyed,
    error_key,
    linear_graph,
    nonlinear_factors,
    object_key,
    pose_key,
    start_graph,
)
from saga_fg.ego.record import EgoMoment
from saga_fg.ego.settings import JointSettings
from saga_fg.geometry import transform_points, yaw_transform
from saga_fg.interactions import POSITION, VELOCITY


class Window:
    """Moments with their keys, `record`, and where all variables of the window are, `values`."""

    def __init__(self, settings: JointSettings) -> None:
        self._settings = settings
        self._prior = gtsam.NonlinearFactorGraph()
        self._known: set[int] = set()
        self.values = gtsam.Values()
        self.record: Keyed = []

    @property
    def path(self) -> FloatArray:
        """The poses (n, 4, 4)."""
        return np.stack([self.values.atPose3(pose_key(k)).matrix() for k, _ in self.record])

    def predicted(self, time: float, a_T_b: FloatArray) -> FloatArray:
        """The pose (4, 4) after the motion a_T_b, the errors that the odometry is known to have taken out."""
        k, last = self.record[-1]
        scale, bias, course = self.values.atVector(error_key(k))
        step = yaw_transform(yaw=-bias * (time - last.time)) @ a_T_b
        step[:3, 3] = yaw_transform(yaw=-course)[:3, :3] @ a_T_b[:3, 3] / (1 + scale)
        return np.asarray(self.values.atPose3(pose_key(k)).matrix() @ step)

    def add(self, moment: EgoMoment, pose: FloatArray) -> int:
        """Add a moment with its variables: objects where they were going, new ones where they were detected."""
        values = self.values = gtsam.Values(self.values)
        j, time = (self.record[-1][0], self.record[-1][1].time) if self.record else (-1, moment.time)
        k = j + 1
        values.insert(pose_key(k), gtsam.Pose3(pose))
        values.insert(error_key(k), values.atVector(error_key(j)) if self.record else np.zeros(ERROR_DIM))
        seen = dict(zip(moment.seen.id.tolist(), transform_points(pose, moment.seen.z)[:, :2], strict=True))
        for name, node_type in zip(moment.objects.id.tolist(), moment.objects.types, strict=True):
            if self.record and values.exists(object_key(j, name)):
                state = values.atVector(object_key(j, name))
                state[node_type.index(POSITION)] += (moment.time - time) * state[node_type.index(VELOCITY)]
            else:
                state = np.zeros(node_type.dim)
                state[node_type.index(POSITION)] = seen[name]
            values.insert(object_key(k, name), state)
        if not self.record:
            self._prior = start_graph(k, pose, self._settings)
        self.record.append((k, moment))
        return k

    def assume(self, prior: gtsam.NonlinearFactorGraph) -> None:
        """Take in what is known beforehand of variables that were inserted into `values`."""
        self._prior.push_back(prior)

    def solve(
        self, standing: Sequence[FloatArray], native: gtsam.NonlinearFactorGraph, factors: Iterable[Linearisable]
    ) -> Solution:
        """Solve anew; standing: probabilities that objects stand; native, factors: of what else is in the window."""
        graph = self._prior.clone()
        graph.push_back(linear_graph(self.record, self._known))
        graph.push_back(native)
        every = [*factors, *nonlinear_factors(self.record, self._settings, standing)]
        solver = SolverSettings(max_iterations=self._settings.max_iterations, tolerance=TOLERANCE)
        solution = solve(graph, every, self.values, solver)
        self.values = solution.values
        return solution

    def older_than(self, time: float) -> int:
        """How many moments may leave so that one at `time` or before still stays, if there is one."""
        return sum(moment.time <= time for _, moment in self.record[1:])

    def leave(self, count: int, others: Iterable[int], solution: Solution) -> None:
        """Let the first moments leave, and other variables that nobody in the rest of the window speaks of."""
        leaving, self.record = self.record[:count], self.record[count:]
        self._known = set(np.intersect1d(leaving[-1][1].objects.id, self.record[0][1].objects.id).tolist())
        keys = {*others, *(key for k, moment in leaving for key in _keys(k, moment))}
        self._prior = _marginalised(solution, keys, self._prior)
        self.values = gtsam.Values(self.values)
        for key in keys:
            self.values.erase(key)


def _keys(k: int, moment: EgoMoment) -> list[int]:
    """The variables of a moment."""
    return [pose_key(k), error_key(k), *(object_key(k, name) for name in moment.objects.id.tolist())]


def _marginalised(
    solution: Solution, leaving: set[int], prior: gtsam.NonlinearFactorGraph
) -> gtsam.NonlinearFactorGraph:
    """What a window says of the variables that stay without those that leave: the prior of the rest."""
    linear = solution.linear
    touched = gtsam.GaussianFactorGraph()
    for i in range(linear.size()):
        if not leaving.isdisjoint(linear.at(i).keys()):
            touched.push_back(linear.at(i))
    remaining = marginal_factors(touched, sorted(leaving), "qr")
    kept = gtsam.NonlinearFactorGraph()
    for i in range(prior.size()):
        if leaving.isdisjoint(prior.at(i).keys()):
            kept.add(prior.at(i))
    kept.push_back(nonlinear_graph_at((remaining.at(i) for i in range(remaining.size())), solution.values))
    return kept

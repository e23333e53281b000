"""Joint filter over trajectories: all objects in one state, coupled by rules, measured whenever they are seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from benchmarks.independent_filter import INITIAL_SPEED_DEVIATION, FilteredTrajectories
from saga_fg.estimators import JointKalmanFilter, Measurements
from saga_fg.model.discretisation import discretise
from saga_fg.model.edge_rules import EdgeRule
from saga_fg.model.graph_building import build_graph
from saga_fg.model.interactions import NodeTable
from saga_fg.model.motion import ConstantVelocity, NodeType
from saga_fg.numerics.arrays import IntArray
from saga_fg.types.by_class import DEFAULT
from saga_fg.types.labelled_objects import LabelledObjects

_H = np.eye(2, 4)


class JointView:
    """One recording under some edge rules.

    filtered        headings and who has moved; the estimates are the joint filter's own
    noise           acceleration noise by class, m^2/s^3, with `default`; position_noise, m
    """

    def __init__(
        self,
        trajectories: LabelledObjects,
        filtered: FilteredTrajectories,
        noise: Mapping[str, float],
        position_noise: float,
        rules: Sequence[EdgeRule],
        explained_noise: float = 0.0,
    ) -> None:
        self._trajectories, self._filtered = trajectories, filtered
        self._rules, self._explained = tuple(rules), explained_noise
        self._R = position_noise**2 * np.eye(2)
        by_class = {c: NodeType(c, ConstantVelocity(noise.get(c, noise[DEFAULT]))) for c in set(trajectories.label)}
        self._types = [by_class[c] for c in trajectories.label]
        self._initial = np.diag(np.repeat([position_noise**2, INITIAL_SPEED_DEVIATION**2], 2))

    def log_likelihood(self) -> tuple[float, int]:
        """Log-likelihood of all positions but the first of each object, and their number."""
        seen = np.isfinite(self._trajectories.position[..., 0])
        state, present, total, count = JointKalmanFilter(), np.empty(0, dtype=np.int64), 0.0, 0
        for k in range(len(self._trajectories)):
            now = np.flatnonzero(seen[k])
            lost = np.setdiff1d(present, now)
            if len(lost):
                state.marginalise(lost)
            kept = np.setdiff1d(present, lost)
            if len(kept):
                self._predict(state, kept, k - 1, self._trajectories.time[k] - self._trajectories.time[k - 1])
                total += self._measure(state, kept, k)
                count += len(kept)
            new = np.setdiff1d(now, kept)
            if len(new):
                mean = np.concatenate([self._trajectories.position[k, new], np.zeros((len(new), 2))], axis=1)
                state.add(new, mean, np.tile(self._initial, (len(new), 1, 1)))
            present = now
        return total, count

    def _predict(self, state: JointKalmanFilter, rows: IntArray, k: int, dt: float) -> None:
        mean, heading = state.mean(rows), self._filtered.heading[k, rows]
        nodes = NodeTable(
            rows,
            self._trajectories.label[rows],
            tuple(self._types[row] for row in rows),
            mean[:, :2],
            mean[:, 2:],
            np.where(np.isfinite(heading), heading, np.arctan2(mean[:, 3], mean[:, 2])),
            self._trajectories.length[rows],
            np.trace(state.covariance(rows)[:, 2:, 2:], axis1=1, axis2=2) / 2,
            self._filtered.has_moved[k, rows],
            unseen=np.zeros(len(rows)),
        )
        state.predict(discretise(build_graph(nodes, self._rules, explained_noise=self._explained), dt))

    def _measure(self, state: JointKalmanFilter, rows: IntArray, k: int) -> float:
        """The log-likelihood of the positions of `rows` at moment k."""
        return state.update(Measurements(rows, self._trajectories.position[k, rows], _H, self._R)) if len(rows) else 0.0

"""Joint filter over trajectories with gaps: all objects in one state, coupled by rules.

Every object is measured at every time at which it is seen. Where gaps begin the joint state is kept, and each gap is
filtered from there: neighbours are measured at every step, the hidden object is not.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from saga_fg.estimators import JointKalmanFilter, Measurements
from saga_fg.learning.gap_prediction import SUBSTEPS, TURNS_ABOVE
from saga_fg.learning.gaps import GapSample, GapSettings, gap_moments
from saga_fg.learning.independent_filter import INITIAL_SPEED_DEVIATION, FilteredTrajectories
from saga_fg.learning.trajectories import Trajectories
from saga_fg.model.discretisation import discretise
from saga_fg.model.edge_rules import EdgeRule
from saga_fg.model.graph_building import build_graph
from saga_fg.model.interactions import NodeTable
from saga_fg.model.motion import ConstantVelocity, NodeType
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.types.by_class import DEFAULT

_H = np.eye(2, 4)


class JointGaps:
    """One recording under some edge rules.

    filtered        headings and who has moved; the estimates are the joint filter's own
    noise           acceleration noise by class, m^2/s^3, with `default`; position_noise, m
    """

    def __init__(
        self,
        trajectories: Trajectories,
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

    def errors(self, gaps: GapSample, settings: GapSettings) -> FloatArray:
        """Position errors (W, S), m, of the predictions through the gaps."""
        _, stride, steps = gap_moments(self._trajectories, settings)
        errors = np.full((len(gaps), steps), np.nan)
        for k, state, present, _ in self._in_view(int(gaps.moment.max(initial=-1)) + 1):
            rows = np.flatnonzero(gaps.moment == k)
            if len(rows):
                start = state.snapshot()
                for w in rows.tolist():
                    state.restore(start)
                    errors[w] = self._gap_errors(state, present, int(gaps.row[w]), k, stride, steps)
                state.restore(start)
        return errors

    def log_likelihood(self) -> tuple[float, int]:
        """Log-likelihood of all positions but the first of each object, and their number."""
        steps = [result for *_, result in self._in_view(len(self._trajectories))]
        return sum(log for log, _ in steps), sum(count for _, count in steps)

    def _in_view(self, moments: int) -> Iterator[tuple[int, JointKalmanFilter, IntArray, tuple[float, int]]]:
        """After each moment: the filter, the rows in view, and log-likelihood and number of the positions measured."""
        seen = np.isfinite(self._trajectories.position[..., 0])
        state, present = JointKalmanFilter(), np.empty(0, dtype=np.int64)
        for k in range(moments):
            now = np.flatnonzero(seen[k])
            lost = np.setdiff1d(present, now)
            if len(lost):
                state.marginalise(lost)
            kept, log = np.setdiff1d(present, lost), 0.0
            if len(kept):
                dt = self._trajectories.time[k] - self._trajectories.time[k - 1]
                self._predict(state, kept, self._filtered.heading[k - 1], k - 1, dt)
                log = self._measure(state, kept, k)
            new = np.setdiff1d(now, kept)
            if len(new):
                mean = np.concatenate([self._trajectories.position[k, new], np.zeros((len(new), 2))], axis=1)
                state.add(new, mean, np.tile(self._initial, (len(new), 1, 1)))
            present = now
            yield k, state, present, (log, len(kept))

    def _gap_errors(
        self, state: JointKalmanFilter, present: IntArray, hidden: int, k: int, stride: int, steps: int
    ) -> FloatArray:
        """(S,) errors of one object that is hidden from moment k on."""
        errors = np.full(steps, np.nan)
        course = self._filtered.heading[k].copy()
        for step in range(steps):
            before, at = k + step * stride, k + (step + 1) * stride
            if at >= len(self._trajectories):
                break
            dt = (self._trajectories.time[at] - self._trajectories.time[before]) / SUBSTEPS
            for part in range(SUBSTEPS):
                heading = self._filtered.heading[before].copy()
                heading[hidden] = course[hidden]
                v = state.mean([hidden])[0, 2:]
                self._predict(
                    state,
                    present,
                    heading,
                    before,
                    dt,
                    hidden_moved=bool(self._filtered.has_moved[k, hidden]),
                    hidden=hidden,
                    unseen=self._trajectories.time[before] - self._trajectories.time[k] + part * dt,
                )
                new = state.mean([hidden])[0, 2:]
                if self._filtered.has_moved[k, hidden] and v @ v > TURNS_ABOVE**2:
                    course[hidden] += np.arctan2(v[0] * new[1] - v[1] * new[0], v @ new)
            here = np.isfinite(self._trajectories.position[at, :, 0])
            lost = present[~here[present] & (present != hidden)]
            if len(lost):
                state.marginalise(lost)
                present = np.setdiff1d(present, lost)
            self._measure(state, present[present != hidden], at)
            errors[step] = np.hypot(*(self._trajectories.position[at, hidden] - state.mean([hidden])[0, :2]))
        return errors

    def _predict(
        self,
        state: JointKalmanFilter,
        rows: IntArray,
        heading: FloatArray,
        k: int,
        dt: float,
        hidden: int = -1,
        hidden_moved: bool = False,
        unseen: float = 0.0,
    ) -> None:
        mean = state.mean(rows)
        moved = self._filtered.has_moved[k, rows].copy()
        moved[rows == hidden] = hidden_moved
        nodes = NodeTable(
            rows,
            self._trajectories.label[rows],
            tuple(self._types[row] for row in rows),
            mean[:, :2],
            mean[:, 2:],
            np.where(np.isfinite(heading[rows]), heading[rows], np.arctan2(mean[:, 3], mean[:, 2])),
            self._trajectories.length[rows],
            np.trace(state.covariance(rows)[:, 2:, 2:], axis1=1, axis2=2) / 2,
            moved,
            unseen=np.where(rows == hidden, unseen, 0.0),
        )
        state.predict(discretise(build_graph(nodes, self._rules, explained_noise=self._explained), dt))

    def _measure(self, state: JointKalmanFilter, rows: IntArray, k: int) -> float:
        """The log-likelihood of the positions of `rows` at moment k."""
        return state.update(Measurements(rows, self._trajectories.position[k, rows], _H, self._R)) if len(rows) else 0.0

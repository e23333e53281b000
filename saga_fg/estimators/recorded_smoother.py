"""Smoothers over a recording: their answers, and the methods that they share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from factors import Robust
from saga_fg.errors import InputError, require_type
from saga_fg.estimators.backward import MarginalCovariances, SmoothedCovariance
from saga_fg.estimators.base import EstimatorBase, live_rows
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.graduated import GraduatedNonConvexity
from saga_fg.estimators.interval_dynamics import IntervalDynamics
from saga_fg.estimators.layout import StateLayout
from saga_fg.estimators.measurements import Observations, RecordedMeasurements
from saga_fg.estimators.protocol import Measurements
from saga_fg.estimators.recording import Recording
from saga_fg.model.transition import Transition
from saga_fg.numerics.arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class JointCovariance:
    """Joint covariance (D, D) of all nodes of a layout."""

    layout: StateLayout
    matrix: FloatArray

    def joint(self, rows: IntArray) -> FloatArray:
        """Joint covariance of the nodes at `rows`, in this order."""
        at = self.layout.places(rows)
        return np.asarray(self.matrix[np.ix_(at, at)])

    def blocks(self, rows: IntArray) -> FloatArray:
        """(k, d, d) of the nodes at `rows`, whose states have equal size d."""
        at = self.layout.spans(rows)
        return np.asarray(self.matrix[at[:, :, None], at[:, None, :]])


@dataclass(frozen=True, eq=False)
class SmoothedState:
    """Marginals of an epoch's nodes given all measurements; the nodes that leave after it are among them.

    time (s, on the estimator's clock); layout of the joint state; state (D,): its smoothed mean; P: its covariance,
    None where only means were asked for. The methods are those of `Estimator`.
    """

    time: float
    layout: StateLayout
    state: FloatArray
    P: SmoothedCovariance | MarginalCovariances | JointCovariance | None = None

    @property
    def nodes(self) -> IntArray:
        """(n,) ids in the order of the joint state."""
        return self.layout.nodes

    def mean(self, nodes: ArrayLike) -> FloatArray:
        """(k, d) means of nodes of equal size d."""
        return np.asarray(self.state[self.layout.spans(self.layout.rows(nodes))])

    def covariance(self, nodes: ArrayLike) -> FloatArray:
        """(k, d, d) marginal covariances of nodes of equal size d."""
        rows = self.layout.rows(nodes)
        self.layout.spans(rows)
        return self._covariance().blocks(rows)

    def joint_mean(self, nodes: ArrayLike) -> FloatArray:
        """Stacked mean of some nodes, in the order given, of any sizes."""
        return np.asarray(self.state[self.layout.places(self.layout.rows(nodes))])

    def joint_covariance(self, nodes: ArrayLike) -> FloatArray:
        """Joint covariance of some nodes, in the order given, of any sizes."""
        return self._covariance().joint(self.layout.rows(nodes))

    def _covariance(self) -> SmoothedCovariance | MarginalCovariances | JointCovariance:
        if self.P is None:
            raise InputError("covariances: only means were smoothed; ask for covariances")
        return self.P


class RecordedSmoother(EstimatorBase):
    """A smoother that keeps a recording. See `saga_fg.estimators.protocol.Estimator` for the methods."""

    _recording: Recording
    _most: int | None = None  # largest number of nodes of a component

    @property
    def time(self) -> float:
        """Time of the newest epoch: the sum of all intervals, s."""
        return self._recording.time

    @property
    def start(self) -> float:
        """Time of the first epoch that is kept; older measurements are refused, s."""
        return self._recording.epochs[0].time

    @property
    def nodes(self) -> IntArray:
        return self._recording.layout.nodes

    def add(
        self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike, labels: Mapping[int, str] | None = None
    ) -> None:
        self._recording.add(nodes, means, covariances)

    def predict(self, transition: Transition) -> None:
        self._recording.predict(IntervalDynamics(transition, self._most))

    def update(
        self,
        measurements: Measurements | Observations | Sequence[Measurements | Observations],
        time: float | None = None,
        robust: Robust | None = None,
    ) -> float:
        """Take in measurements, of several kinds if need be, made at `time` (s, on the smoother's clock), None for now.

        An interval that contains `time` is split: its recorded graph is discretised anew over both parts, its edges
        kept. Returns the log-likelihood of the measurements given all taken in before; with nonlinear or robust parts,
        that of the linearisation; NaN where nothing is computed before it is asked for. Raises `InputError` for a time
        outside the recording.
        """
        if robust is not None:
            require_type("robust", robust, Robust)
        return self._take_in(measurements, time, robust)

    def _take_in(
        self,
        measurements: Measurements | Observations | Sequence[Measurements | Observations],
        time: float | None,
        robust: Robust | GraduatedNonConvexity | None,
    ) -> float:
        """Take in all, or none where one can't be taken."""
        before = self._recording.snapshot()
        given = measurements if isinstance(measurements, Sequence) else (measurements,)
        try:
            return sum(self._recording.update(RecordedMeasurements(each, robust), time) for each in given)
        except BaseException:
            self._recording.restore(before)
            raise

    def marginalise(self, nodes: ArrayLike) -> None:
        self._recording.marginalise(nodes)

    def posterior(self) -> BlockGaussian:
        """Filtered posterior of the present nodes, and perhaps of some that have just left."""
        return self._recording.latest()

    def _at(self, nodes: ArrayLike) -> tuple[BlockGaussian, IntArray]:
        return live_rows(self.posterior(), self._recording.layout, nodes)

    def _smoothed(self, covariances: bool, joint: bool) -> tuple[SmoothedState, ...]:
        """Every epoch of the recording, oldest first."""
        recording = self._recording
        P: Sequence[SmoothedCovariance | MarginalCovariances | None]
        if not covariances:
            means, P = recording.means(), [None] * len(recording.epochs)
        elif joint:
            means, P = recording.means(), recording.joint_covariances()
        else:
            means, P = recording.marginals()
        return tuple(
            SmoothedState(epoch.time, layout, mean, covariance)
            for epoch, layout, mean, covariance in zip(recording.epochs, recording.layouts, means, P, strict=True)
        )

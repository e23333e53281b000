"""Smoothers over a record of epochs: what they share, and the one whose memory does not grow.

The windowed smoother: a recording without an end, smoothed as it goes by, in memory that does not grow.

A window slides over the recording. On its past side nothing is lost: what was known when the window begins is carried
along as a joint prior, exactly. On its future side the smoother waits until whatever may still be measured cannot be
expected to move an epoch any more: with s the standard deviations of `saga_fg.estimators.backward.future_influence`,

    5 s <= tolerance        for every component of this epoch and of all before it.

Such epochs are final. They are those of the batch smoother to the tolerance, whatever the
memory of a graph is: an object in view settles in a second or two, a hidden one when it is seen again, or has left.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import ArrayLike

from factors import Robust
from saga_fg.errors import InputError, require_type
from saga_fg.estimators.backward import GaussNewtonSettings, MarginalCovariances, SmoothedCovariance, future_influence
from saga_fg.estimators.base import EstimatorBase, live_rows
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.dynamics import checked_most
from saga_fg.estimators.graduated import GraduatedNonConvexity
from saga_fg.estimators.interval_dynamics import IntervalDynamics
from saga_fg.estimators.measurements import Observations, RecordedMeasurements
from saga_fg.estimators.partition import StateLayout
from saga_fg.estimators.protocol import Measurements
from saga_fg.estimators.recording import Recording
from saga_fg.model.discretisation import Transition
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.settings import NonNegative, Positive, Settings, setting


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


_SURE = 5.0  # standard deviations


@dataclass(frozen=True)
class WindowSettings(Settings):
    """Settings of the sliding window."""

    step: Positive = setting(5.0, "time between two searches for final epochs, s; higher: faster, more memory")
    tolerance: Positive = setting(
        1e-3, "largest difference of a final mean from the batch smoother, m (m/s, ...); lower: a longer window"
    )
    longest: Positive = setting(60.0, "epochs older than this are final in any case, s; bounds the memory")
    late: NonNegative = setting(0.0, "largest delay of a measurement, s; higher: a longer window")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.late > self.longest:
            raise InputError(f"late: expected a number from 0 to {self.longest:g}, got {self.late!r}")


class WindowedSmoother(RecordedSmoother):
    """Takes in a recording and gives out smoothed epochs, oldest first, each once.

        smoother.predict(...); smoother.update(...); for epoch in smoother.final(): ...
        for epoch in smoother.finish(): ...                                       # after the last measurement

    settings     of the window
    gauss_newton for what is nonlinear or robust; it is linearised within the window, so that there the past side, too,
                 is as good as the linearisation
    max_component as of `BatchSmoother`
    """

    def __init__(
        self,
        settings: WindowSettings | None = None,
        gauss_newton: GaussNewtonSettings | None = None,
        max_component: int | None = None,
    ) -> None:
        self._settings, self._most = settings or WindowSettings(), checked_most(max_component)
        self._recording = Recording(gauss_newton, lazy=True)
        self._next_look = self._settings.step
        self._bound = 0.0

    @property
    def bound(self) -> float:
        """Largest change that later measurements could make to final epochs; forced by `longest` above `tolerance`."""
        return self._bound

    def final(self) -> tuple[SmoothedState, ...]:
        """Epochs that have become final, with the covariances of their nodes: none most of the time."""
        if self.time < self._next_look:
            return ()
        self._next_look = self.time + self._settings.step
        return self._given_out(self._settled())

    def finish(self) -> tuple[SmoothedState, ...]:
        """All epochs that are left. Nothing can be taken in afterwards."""
        epochs = self._smoothed(covariances=True, joint=False)
        self._recording = Recording()
        return epochs

    def _settled(self) -> int:
        """Number of epochs of the window that are final."""
        settings, times = self._settings, np.array([epoch.time for epoch in self._recording.epochs])
        known = max(1, int(np.searchsorted(times, self.time - settings.late + 1e-9)))  # before it, all is measured
        steps = islice(self._recording.backwards(), len(times) - known, None)
        influence = np.array([s.max(initial=0.0) for s in future_influence(steps)][::-1])
        influence *= _SURE
        waiting = np.flatnonzero(influence > settings.tolerance)
        settled = int(waiting[0]) if len(waiting) else known - 1
        forced = min(int(np.searchsorted(times, self.time - settings.longest)), known - 1)
        self._bound = max(self._bound, float(influence[: max(settled, forced)].max(initial=0.0)))
        return max(settled, forced)

    def _given_out(self, count: int) -> tuple[SmoothedState, ...]:
        if count == 0:
            return ()
        epochs = self._smoothed(covariances=True, joint=False)[:count]
        self._recording.drop(count)
        return epochs

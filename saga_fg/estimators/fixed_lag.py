"""The fixed-lag smoother: everything within a window of seconds, smoothed; late measurements where they belong.

The factors of the window, with what the filter knew at its start as prior,

    prior        phi(x(t0))
    interaction  || x_i(t+dt) - sum_j F_ij x_j(t) - b_i ||_{Q_i}     one a node and interval
    detection    || z - h(x_i(t)) ||_{R}                              optionally robust

are solved exactly where they are linear, by Gauss-Newton over the window where they are not. The elimination order is
that of time, which for a chain of dense joint states is the best there is; it is carried out in covariance form, as
filter and smoother, by components (`saga_fg.estimators.backward`). The newest state is the filter's.
"""

from __future__ import annotations

import copy
import math

from numpy.typing import ArrayLike

from factors import Robust
from saga_fg.errors import InputError
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.motion import Motion
from saga_fg.estimators.newest import NewestMarginals, live_rows
from saga_fg.estimators.protocol import Measurements
from saga_fg.estimators.recording import GaussNewtonSettings, Recording, RecordingState
from saga_fg.estimators.sighting import Observations, along_the_way
from saga_fg.estimators.smoothed import Smoothed, smoothed_moments
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.model.transition import Transition
from saga_fg.numerics.arrays import IntArray


class FixedLagSmoother(NewestMarginals):
    """The exact smoother over the last `lag` seconds. See `saga_fg.estimators.protocol.Estimator` for the methods.

    lag       s; at 0 it is the filter. The window begins at the last moment that is at least `lag` old, so that every
              measurement up to `lag` late finds its interval
    settings  of Gauss-Newton, for what is nonlinear or robust

    `mean`, `covariance` and their like speak of the newest moment, `smoothed` of all moments in the window.
    """

    def __init__(self, lag: float, settings: GaussNewtonSettings | None = None) -> None:
        if not (math.isfinite(lag) and lag >= 0):
            raise InputError(f"lag: expected a finite number of seconds >= 0, got {lag!r}")
        self._lag = float(lag)
        self._recording = Recording(settings)

    def __copy__(self) -> FixedLagSmoother:
        twin = FixedLagSmoother(self._lag)
        twin._recording = copy.copy(self._recording)
        return twin

    @property
    def lag(self) -> float:
        """Length of the window, s."""
        return self._lag

    @property
    def time(self) -> float:
        """Of the newest moment: the sum of all intervals, s."""
        return self._recording.time

    @property
    def start(self) -> float:
        """Time at which the window begins; nothing older can be taken in, s."""
        return self._recording.moments[0].time

    @property
    def nodes(self) -> IntArray:
        return self._recording.layout.nodes

    def add(self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike) -> None:
        self._recording.add(nodes, means, covariances)

    def predict(self, transition: Transition) -> None:
        self._recording.move(Motion(transition))
        self._recording.forget(self.time - self._lag)

    def update(
        self, measurements: Measurements | Observations, time: float | None = None, robust: Robust | None = None
    ) -> float:
        """Take in measurements made at `time` (s, on the smoother's clock), None for now.

        An interval that contains `time` is split: its recorded graph is discretised anew over both parts, its edges
        kept. Returns the log-likelihood of the measurements given all taken in before; where the window holds something
        nonlinear or robust, that of its linearisation. Raises `InputError` for a time outside the window.
        """
        return self._recording.see(along_the_way(measurements, robust), time)

    def marginalise(self, nodes: ArrayLike) -> None:
        self._recording.leave(nodes)

    def smoothed(self, covariances: bool = True) -> tuple[Smoothed, ...]:
        """Every moment in the window, oldest first; without `covariances` means only, which costs much less."""
        return smoothed_moments(self._recording, covariances, joint=True)

    def posterior(self) -> BlockGaussian:
        """The filter's, of the nodes that are there now, and perhaps of some that just went."""
        return self._recording.newest()

    def graph(self) -> SceneFactorGraph:
        """The window as a running graph: a prior at its start, all factors since, the smoothed means as values."""
        return self._recording.graph()

    def snapshot(self) -> RecordingState:
        """The whole state, as a value."""
        return self._recording.snapshot()

    def restore(self, state: RecordingState) -> None:
        """Continue from a snapshot, bit-identically."""
        self._recording.restore(state)

    def _at(self, nodes: ArrayLike) -> tuple[BlockGaussian, IntArray]:
        return live_rows(self.posterior(), self._recording.layout, nodes)

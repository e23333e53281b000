"""The fixed-lag smoother: everything within a window of seconds, smoothed; late measurements in their place.

The factors of the window, with the filter's posterior at its start as prior,

    prior        phi(x(t0))
    interaction  || x_i(t+dt) - sum_j F_ij x_j(t) - b_i ||_{Q_i}     one a node and interval
    detection    || z - h(x_i(t)) ||_{R}                              optionally robust

are solved exactly where they are linear, by Gauss-Newton over the window where they are not. They are eliminated in the
order of time, the best one for a chain of dense joint states, in covariance form as filter and smoother, by components
(`saga_fg.estimators.backward`). The newest state is the filter's.
"""

from __future__ import annotations

import copy
import math

from saga_fg.errors import InputError
from saga_fg.estimators.gauss_newton import GaussNewtonSettings
from saga_fg.estimators.recorded_smoother import RecordedSmoother, SmoothedState
from saga_fg.estimators.recording import Recording, RecordingState
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.model.transition import Transition


class FixedLagSmoother(RecordedSmoother):
    """The exact smoother over the last `lag` seconds. See `saga_fg.estimators.protocol.Estimator` for the methods.

    lag       s; at 0 it is the filter. The window begins at the last epoch that is at least `lag` old, so that every
              measurement up to `lag` late finds its interval
    settings  of Gauss-Newton, for nonlinear and robust factors

    `mean`, `covariance` and their like are those of the newest epoch, `smoothed` gives all epochs in the window.
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

    def predict(self, transition: Transition) -> None:
        super().predict(transition)
        self._recording.drop_before(self.time - self._lag)

    def smoothed(self, covariances: bool = True) -> tuple[SmoothedState, ...]:
        """Every epoch in the window, oldest first; without `covariances` means only, which costs much less."""
        return self._smoothed(covariances, joint=True)

    def graph(self) -> SceneFactorGraph:
        """The window as a running graph: a prior at its start, all factors since, the smoothed means as values."""
        return self._recording.graph()

    def snapshot(self) -> RecordingState:
        """The whole state, as a value."""
        return self._recording.snapshot()

    def restore(self, state: RecordingState) -> None:
        """Continue from a snapshot, bit-identically."""
        self._recording.restore(state)

"""The windowed smoother: a recording without an end, smoothed as it goes by, in memory that does not grow.

A window slides over the recording. On its past side nothing is lost: what was known when the window begins is carried
along as a joint prior, exactly. On its future side the smoother waits until whatever may still be measured cannot be
expected to move an epoch any more: with s the standard deviations of `saga_fg.estimators.backward.future_influence`,

    5 s <= tolerance        for every component of this epoch and of all before it.

Such epochs are final. They are those of the batch smoother to the tolerance, whatever the
memory of a graph is: an object in view settles in a second or two, a hidden one when it is seen again, or has left.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice

import numpy as np

from saga_fg.errors import InputError
from saga_fg.estimators.backward import future_influence
from saga_fg.estimators.bounds import checked_most
from saga_fg.estimators.gauss_newton import GaussNewtonSettings
from saga_fg.estimators.recorded_smoother import RecordedSmoother, SmoothedState
from saga_fg.estimators.recording import Recording
from saga_fg.settings import NonNegative, Positive, Settings, setting

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

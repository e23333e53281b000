"""The windowed smoother: a recording without an end, smoothed as it goes by, in memory that does not grow.

A window slides over the recording. On its past side nothing is lost: what was known when the window begins is carried
along as a joint prior, exactly. On its future side the smoother waits until whatever may still be measured cannot be
expected to move a moment any more: with s the standard deviations of `saga_fg.estimators.backward.future_influence`,

    5 s <= tolerance        for every component of this moment and of all before it.

Such moments are final. They are those of the batch smoother to the tolerance, without anybody guessing how long the
memory of a graph is: an object in view settles in a second or two, a hidden one when it is seen again, or has gone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from factors import Robust
from saga_fg.errors import InputError
from saga_fg.estimators.backward import future_influence
from saga_fg.estimators.motion import Motion
from saga_fg.estimators.protocol import Measurements
from saga_fg.estimators.recording import GaussNewtonSettings, Recording
from saga_fg.estimators.sighting import Observations, along_the_way
from saga_fg.estimators.smoothed import Smoothed, smoothed_moments
from saga_fg.model.transition import Transition
from saga_fg.numerics.arrays import IntArray
from saga_fg.settings import NonNegative, Positive, Settings, setting

_SURE = 5.0  # standard deviations


@dataclass(frozen=True)
class WindowSettings(Settings):
    """How a window slides."""

    step: Positive = setting(5.0, "s from one look at what has become final to the next")
    tolerance: Positive = setting(
        1e-3, "by which a final mean may differ from that of the batch smoother, m (m/s, ...)"
    )
    longest: Positive = setting(60.0, "s after which a moment is taken as final in any case, which bounds the memory")
    late: NonNegative = setting(0.0, "s by which measurements may come late: so much longer everything has to wait")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.late > self.longest:
            raise InputError(f"late: expected a number from 0 to {self.longest:g}, got {self.late!r}")


class WindowedSmoother:
    """Takes in a recording and gives out smoothed moments, oldest first, each once.

        smoother.predict(...); smoother.update(...); for moment in smoother.final(): ...
        for moment in smoother.finish(): ...                                       # after the last measurement

    settings     of the window
    gauss_newton for what is nonlinear or robust; it is linearised within the window, so that there the past side, too,
                 is as good as the linearisation
    """

    def __init__(self, settings: WindowSettings | None = None, gauss_newton: GaussNewtonSettings | None = None) -> None:
        self._settings = settings or WindowSettings()
        self._recording = Recording(gauss_newton, lazy=True)
        self._next_look = self._settings.step
        self._bound = 0.0

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
        """Ids of the nodes that are there now."""
        return self._recording.layout.nodes

    @property
    def bound(self) -> float:
        """By how much the future could move what was given out; above `tolerance` only where `longest` forced it."""
        return self._bound

    def add(self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike) -> None:
        """Nodes that appear: ids (k,), means (k, d), covariances (k, d, d)."""
        self._recording.add(nodes, means, covariances)

    def predict(self, transition: Transition) -> None:
        """Move all nodes by a transition over exactly those that are there."""
        self._recording.move(Motion(transition))

    def update(
        self, measurements: Measurements | Observations, time: float | None = None, robust: Robust | None = None
    ) -> None:
        """Take in measurements made at `time` (s, on the smoother's clock), None for now.

        Raises `InputError` for a time before `start`.
        """
        self._recording.see(along_the_way(measurements, robust), time)

    def marginalise(self, nodes: ArrayLike) -> None:
        """Nodes that disappear."""
        self._recording.leave(nodes)

    def final(self) -> tuple[Smoothed, ...]:
        """The moments that have become final, with the covariances of their nodes: none most of the time."""
        if self.time < self._next_look:
            return ()
        self._next_look = self.time + self._settings.step
        return self._given_out(self._settled())

    def finish(self) -> tuple[Smoothed, ...]:
        """All moments that are left. Nothing can be taken in afterwards."""
        moments = smoothed_moments(self._recording, covariances=True, joint=False)
        self._recording = Recording()
        return moments

    def _settled(self) -> int:
        """How many moments of the window are final."""
        settings, times = self._settings, np.array([moment.time for moment in self._recording.moments])
        known = max(1, int(np.searchsorted(times, self.time - settings.late + 1e-9)))  # before it, all is measured
        influence = np.array([s.max(initial=0.0) for s in future_influence(self._recording.passes[:known])][::-1])
        influence *= _SURE
        waiting = np.flatnonzero(influence > settings.tolerance)
        settled = int(waiting[0]) if len(waiting) else known - 1
        forced = min(int(np.searchsorted(times, self.time - settings.longest)), known - 1)
        self._bound = max(self._bound, float(influence[: max(settled, forced)].max(initial=0.0)))
        return max(settled, forced)

    def _given_out(self, count: int) -> tuple[Smoothed, ...]:
        if count == 0:
            return ()
        moments = smoothed_moments(self._recording, covariances=True, joint=False)[:count]
        self._recording.drop(count)
        return moments

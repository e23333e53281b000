"""A record of moments with the filter's pass over it: what the smoothers are made of.

Whatever is told is taken in by the filter at once. Told of the past, the filter's pass is done again from there; and
where something is nonlinear or robust, everything recorded is linearised again at the smoothed means until they stand
still, which is Gauss-Newton over the recording (Bell, The iterated Kalman smoother as a Gauss-Newton method, 1994).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.arrays import FloatArray
from saga_fg.errors import InputError
from saga_fg.estimators.backward import SmoothedCovariance, smoothed_covariances, smoothed_means
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.factor_graph import FactorGraph, recording_graph
from saga_fg.estimators.layout import Layout, checked_prior
from saga_fg.estimators.moment import Birth, Moment, Pass, arrival, passed
from saga_fg.estimators.motion import Motion, Standstill
from saga_fg.estimators.sighting import Sighting
from saga_fg.settings import setting

log = logging.getLogger(__name__)

_SAME_TIME = 1e-9  # s


@dataclass(frozen=True)
class GaussNewtonSettings:
    """When the linearisation of what is nonlinear or robust is good enough."""

    max_iterations: int = setting(50, "linearisations of the whole recording at most")
    tolerance: float = setting(1e-10, "largest step of a mean, in standard deviations, at which it has converged")

    def __post_init__(self) -> None:
        if self.max_iterations < 1:
            raise InputError(f"max_iterations: expected at least 1, got {self.max_iterations}")
        if not self.tolerance > 0:
            raise InputError(f"tolerance: expected a positive number, got {self.tolerance}")


@dataclass(frozen=True, eq=False)
class RecordingState:
    """A recording as a value: what was known before, the moments, the filter's pass, whether it has converged."""

    prior: BlockGaussian
    moments: tuple[Moment, ...]
    passes: tuple[Pass, ...]
    converged: bool


class Recording:
    """Moments in order of time, from `time` 0 s on. Every method checks all it is given before it changes anything."""

    def __init__(self, settings: GaussNewtonSettings | None = None) -> None:
        self.settings = settings or GaussNewtonSettings()
        self._layout: Layout | None
        self._means: list[FloatArray] | None
        self._covariances: list[SmoothedCovariance] | None
        self.restore(RecordingState(BlockGaussian.empty(), (Moment(0.0),), (arrival(BlockGaussian.empty()),), True))

    def snapshot(self) -> RecordingState:
        return RecordingState(self._prior, tuple(self._moments), tuple(self._passes), self._converged)

    def restore(self, state: RecordingState) -> None:
        self._prior, self._converged = state.prior, state.converged
        self._moments, self._passes = list(state.moments), list(state.passes)
        self._nonlinear = not all(moment.linear for moment in state.moments)
        self._changed()

    @property
    def time(self) -> float:
        """Of the newest moment, s."""
        return self._moments[-1].time

    @property
    def prior(self) -> BlockGaussian:
        """What was known before the first moment, of the nodes that were there already."""
        return self._prior

    @property
    def moments(self) -> Sequence[Moment]:
        return self._moments

    @property
    def passes(self) -> Sequence[Pass]:
        """The filter's pass, converged."""
        self.solve()
        return self._passes

    @property
    def layout(self) -> Layout:
        """The nodes that are there now."""
        if self._layout is None:
            layout = self._passes[-1].layout
            self._layout = layout.without(layout.rows(self._moments[-1].gone))
        return self._layout

    def newest(self) -> tuple[BlockGaussian, Layout]:
        """The filter's posterior at the newest moment, and the layout it is over (nodes that go included)."""
        self.solve()
        return self._passes[-1].filtered, self._passes[-1].layout

    def add(self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike) -> None:
        mean, covariance = checked_prior(nodes, means, covariances)
        added = self.layout.extended(nodes, mean.shape[1]).nodes[len(self.layout) :]
        if len(added) == 0:
            return
        if np.isin(added, self._moments[-1].gone).any():  # gone and back at the same time: another moment
            self._move(Standstill())
        birth = Birth(added, mean, covariance)
        moment = self._moments[-1]
        self._passes[-1] = self._passes[-1].born(birth)
        self._moments[-1] = replace(moment, births=(*moment.births, birth))
        self._changed()

    def move(self, motion: Motion) -> None:
        """Begin a new moment."""
        motion.check(self.layout)
        self._move(motion)

    def see(self, sighting: Sighting, time: float | None = None) -> float:
        """Take in measurements, of the newest moment or of any `time` within the recording.

        Returns their log-likelihood given all that was known. An interval that contains `time` is split in two.
        """
        k, moments, passes = self._moment_at(self.time if time is None else time)
        newest = k == len(moments) - 1
        sighting.check(self.layout if newest else passes[k].layout)
        if len(sighting.measured) == 0:
            return 0.0
        before = sum(state.log_likelihood for state in self._passes[k:])
        moments[k] = replace(moments[k], sightings=(*moments[k].sightings, sighting))
        passes[k] = passes[k].seen(sighting)
        motion = moments[k].motion
        if motion is not None:
            passes[k], prior = passes[k].moved(moments[k].gone, motion)
            passes[k + 1 :] = passed(prior, moments[k + 1 :])
        self._moments, self._passes = moments, passes
        self._nonlinear |= not sighting.linear
        self._converged = not self._nonlinear
        self._changed()
        return sum(state.log_likelihood for state in passes[k:]) - before

    def leave(self, nodes: ArrayLike) -> None:
        rows = self.layout.rows(nodes)
        if len(set(rows.tolist())) < len(rows):
            raise InputError("nodes: expected each node once")
        moment = self._moments[-1]
        self._moments[-1] = replace(moment, gone=(*moment.gone, *self.layout.nodes[rows].tolist()))
        self._layout = None

    def forget(self, time: float) -> None:
        """Drop the moments before the last one that is not after `time`; what they told becomes the prior."""
        k = 0
        while k + 1 < len(self._moments) and self._moments[k + 1].time <= time + _SAME_TIME:
            k += 1
        if k == 0:
            return
        self.solve()
        self._prior = self._passes[k].arrived
        first = replace(self._passes[k], carried=len(self._prior.layout))
        self._moments = [replace(self._moments[k], births=()), *self._moments[k + 1 :]]
        self._passes = [first, *self._passes[k + 1 :]]
        self._nonlinear = not all(moment.linear for moment in self._moments)
        self._changed()

    def means(self) -> list[FloatArray]:
        """Smoothed joint mean of every moment, over all its nodes (those that go afterwards, too)."""
        self.solve()
        if self._means is None:
            self._means = smoothed_means(self._passes)
        return self._means

    def covariances(self) -> list[SmoothedCovariance]:
        """Smoothed covariance of every moment."""
        self.solve()
        if self._covariances is None:
            self._covariances = list(smoothed_covariances(self._passes))[::-1]
        return self._covariances

    def graph(self) -> FactorGraph:
        """The equivalent factor graph, with the smoothed means as values."""
        means = self.means()
        return recording_graph(self._prior, self._moments, [state.layout for state in self._passes], means)

    def replace_sightings(self, moments: Sequence[Moment]) -> None:
        """Put other moments in place, which differ in their sightings only, and pass over them again."""
        self._passes = passed(self._prior, list(moments), self.means())
        self._moments = list(moments)
        self._nonlinear = not all(moment.linear for moment in moments)
        self._converged = not self._nonlinear
        self._changed()

    def solve(self) -> None:
        """Linearise again until the smoothed means stand still, if anything is nonlinear or robust."""
        if self._converged:
            return
        means, before, share = smoothed_means(self._passes), math.inf, 1.0
        for iteration in range(self.settings.max_iterations):
            passes = passed(self._prior, self._moments, means)
            solved = smoothed_means(passes)
            step = max(
                (
                    float(np.max(np.abs(new - old) / np.sqrt(state.filtered.variances()), initial=0.0))
                    for new, old, state in zip(solved, means, passes, strict=True)
                ),
                default=0.0,
            )
            log.debug("iteration %d: largest step %.3g standard deviations", iteration + 1, step)
            if step <= self.settings.tolerance:
                break
            if step >= before:  # it does not settle: shorter steps
                share /= 2
            before = step
            means = [old + share * (new - old) for new, old in zip(solved, means, strict=True)]
        else:
            log.warning("no convergence in %d iterations; last step %.2g", self.settings.max_iterations, step)
        self._passes, self._means, self._covariances, self._converged = passes, solved, None, True

    def _move(self, motion: Motion | Standstill) -> None:
        self.solve()
        moment = self._moments[-1]
        state, prior = self._passes[-1].moved(moment.gone, motion)
        self._moments[-1], self._passes[-1] = replace(moment, motion=motion), state
        self._moments.append(Moment(moment.time + motion.dt))
        self._passes.append(arrival(prior))
        self._nonlinear |= not motion.linear
        self._changed()

    def _moment_at(self, time: float) -> tuple[int, list[Moment], list[Pass]]:
        """The moment of `time`, with moments and passes in which it is, an interval split if need be."""
        moments, passes = list(self._moments), list(self._passes)
        if not math.isfinite(time):
            raise InputError(f"time: expected a finite number of seconds, got {time!r}")
        first, last = moments[0].time, moments[-1].time
        if time > last + _SAME_TIME:
            raise InputError(f"time: {time:.6f} s is after the newest moment, {last:.6f} s; predict first")
        if time < first - _SAME_TIME:
            raise InputError(f"time: {time:.6f} s is before what is remembered, which begins at {first:.6f} s")
        k = int(np.searchsorted([moment.time for moment in moments], time - _SAME_TIME))
        while k + 1 < len(moments) and moments[k + 1].time <= time + _SAME_TIME:
            k += 1
        if moments[k].time <= time + _SAME_TIME:
            return k, moments, passes
        motion = moments[k - 1].motion
        assert isinstance(motion, Motion)  # a standstill has no inside
        first_part, rest = motion.parts(time - moments[k - 1].time)
        passes[k - 1], prior = passes[k - 1].moved(moments[k - 1].gone, first_part)
        moments[k - 1] = replace(moments[k - 1], motion=first_part)
        moments.insert(k, Moment(time, motion=rest))
        passes.insert(k, arrival(prior))
        return k, moments, passes

    def _changed(self) -> None:
        self._layout = None
        self._means = None
        self._covariances = None

"""A record of moments with the filter's pass over it: what the smoothers are made of.

Told of the past, the filter's pass is done again from there. Where something is nonlinear or robust, everything
recorded is linearised again at the smoothed means until they stand still, which is Gauss-Newton over the recording
(Bell, The iterated Kalman smoother as a Gauss-Newton method, SIAM J. Optimization 4, 1994).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError
from saga_fg.estimators.backward import (
    MarginalCovariances,
    SmoothedCovariance,
    smoothed_covariances,
    smoothed_means,
)
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.factor_graph import recording_graph
from saga_fg.estimators.fixed_point import FixedPoint
from saga_fg.estimators.layout import Layout, checked_prior
from saga_fg.estimators.moment import Birth, Moment, Pass, arrival, passed, reckoned
from saga_fg.estimators.motion import Motion, Standstill
from saga_fg.estimators.protocol import require_kind
from saga_fg.estimators.sighting import Sighting
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.numerics.arrays import FloatArray, checked
from saga_fg.settings import setting

log = logging.getLogger(__name__)

_SAME_TIME = 1e-9  # s


@dataclass(frozen=True)
class GaussNewtonSettings:
    """When the linearisation of what is nonlinear or robust is good enough."""

    max_iterations: int = setting(100, "linearisations of everything recorded at most")
    tolerance: float = setting(1e-9, "largest step of a mean, in standard deviations, at which it has converged")

    def __post_init__(self) -> None:
        if self.max_iterations < 1:
            raise InputError(f"max_iterations: expected at least 1, got {self.max_iterations}")
        if not self.tolerance > 0:
            raise InputError(f"tolerance: expected a positive number, got {self.tolerance}")


@dataclass(frozen=True, eq=False)
class RecordingState:
    """A recording as a value.

    prior of the first moment; moments; layout of each one's nodes; the filter's pass as far as it has come; whether
    everything is linearised where it should be
    """

    prior: BlockGaussian
    moments: tuple[Moment, ...]
    layouts: tuple[Layout, ...]
    passes: tuple[Pass, ...]
    converged: bool


class Recording:
    """Moments in order of time, from 0 s on. Every method checks all it is given before it changes anything.

    With `lazy` the filter's pass waits until somebody asks for an estimate, or something nonlinear comes that must be
    tried; nobody learns the likelihoods meanwhile.
    """

    def __init__(self, settings: GaussNewtonSettings | None = None, lazy: bool = False) -> None:
        self._settings = settings or GaussNewtonSettings()
        self._lazy = lazy
        self._layout: Layout | None = None
        self._means: list[FloatArray] | None = None
        self._covariances: list[SmoothedCovariance] | None = None
        self._marginals: list[MarginalCovariances] | None = None
        nothing = BlockGaussian.empty()
        self.restore(RecordingState(nothing, (Moment(0.0),), (nothing.layout,), (arrival(nothing),), True))

    def __copy__(self) -> Recording:
        twin = Recording(self._settings, self._lazy)
        twin.restore(self.snapshot())
        return twin

    def snapshot(self) -> RecordingState:
        return RecordingState(
            self._prior, tuple(self._moments), tuple(self._layouts), tuple(self._passes), self._converged
        )

    def restore(self, state: RecordingState) -> None:
        require_kind("state", state, RecordingState)
        self._prior, self._converged = state.prior, state.converged
        self._moments, self._layouts, self._passes = list(state.moments), list(state.layouts), list(state.passes)
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
    def linear(self) -> bool:
        """Whether nothing is nonlinear or robust."""
        return not self._nonlinear

    @property
    def layouts(self) -> Sequence[Layout]:
        """Of each moment: all its nodes, those that go afterwards too."""
        return self._layouts

    @property
    def passes(self) -> Sequence[Pass]:
        """The filter's pass, complete and converged."""
        self.solve()
        return self._passes

    @property
    def layout(self) -> Layout:
        """The nodes that are there now."""
        if self._layout is None:
            gone = self._layouts[-1].rows(self._moments[-1].gone)
            self._layout = self._layouts[-1].without(gone) if len(gone) else self._layouts[-1]
        return self._layout

    def add(self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike) -> None:
        mean, covariance = checked_prior(nodes, means, covariances)
        added = self.layout.extended(nodes, mean.shape[1]).nodes[len(self.layout) :]
        if len(added) == 0:
            return
        if np.isin(added, self._moments[-1].gone).any():  # gone and back at the same time: another moment
            self._move(Standstill())
        birth, moment = Birth(added, mean, covariance), self._moments[-1]
        if len(self._passes) == len(self._moments):
            self._passes[-1] = self._passes[-1].born(birth)
        self._moments[-1] = replace(moment, births=(*moment.births, birth))
        self._layouts[-1] = self._layouts[-1].extended(added, mean.shape[1])
        self._changed()

    def move(self, motion: Motion) -> None:
        """Begin a new moment."""
        motion.check(self.layout)
        self._move(motion)

    def see(self, sighting: Sighting, time: float | None = None) -> float:
        """Take in measurements, of the newest moment or of any `time` within the recording.

        Returns their log-likelihood given all that was known, NaN if lazy. An interval that contains `time` is split.
        """
        k, moments, layouts = self._moment_at(self.time if time is None else time)
        newest = k == len(moments) - 1
        sighting.check(self.layout if newest else layouts[k])
        if len(sighting.measured) == 0:
            return 0.0
        inserted = len(moments) > len(self._moments)
        moments[k] = replace(moments[k], sightings=(*moments[k].sightings, sighting))
        passes, likelihood = self._passes[:k], math.nan
        if not (self._lazy and sighting.linear):
            known = _completed(self._passes, self._prior, self._moments)
            passes = known[:k]
            if not inserted:
                passes.append(known[k].seen(sighting))
            passes = _completed(passes, self._prior, moments)
            if not self._lazy:
                likelihood = sum(state.log_likelihood for state in passes[k:])
                likelihood -= sum(state.log_likelihood for state in known[k:])
        elif newest and not inserted and len(self._passes) == len(moments):
            passes.append(self._passes[k].seen(sighting))
        self._moments, self._layouts, self._passes = moments, layouts, passes
        self._nonlinear |= not sighting.linear
        self._converged = not self._nonlinear
        self._changed()
        return likelihood

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
        self.drop(k)

    def drop(self, k: int) -> None:
        """Drop the first k moments; what they told becomes the prior."""
        if k == 0:
            return
        self.solve()
        self._prior = self._passes[k].arrived
        first = replace(self._passes[k], carried=len(self._prior.layout))
        self._moments = [replace(self._moments[k], births=()), *self._moments[k + 1 :]]
        self._layouts, self._passes = self._layouts[k:], [first, *self._passes[k + 1 :]]
        self._nonlinear = not all(moment.linear for moment in self._moments)
        self._changed()

    def newest(self) -> BlockGaussian:
        """The filter's posterior at the newest moment, over all its nodes."""
        self.solve()
        return self._passes[-1].filtered

    def means(self) -> list[FloatArray]:
        """Smoothed joint mean of every moment, over all its nodes (those that go afterwards, too)."""
        self.solve()
        if self._means is None:
            self._means = smoothed_means(self._passes)
        return self._means

    def covariances(self, joint: bool) -> Sequence[SmoothedCovariance | MarginalCovariances]:
        """Smoothed covariance of every moment, joint ones or only those of single nodes, which take less memory."""
        self.solve()
        if self._covariances is None and joint:
            self._covariances = list(smoothed_covariances(self._passes, joint=True))[::-1]
        if self._covariances is not None:
            return self._covariances
        if self._marginals is None:
            wholes = smoothed_covariances(self._passes, joint=False)
            self._marginals = [MarginalCovariances.of(whole) for whole in wholes][::-1]
        return self._marginals

    def graph(self, means: Sequence[FloatArray] | None = None) -> SceneFactorGraph:
        """The equivalent factor graph, with the smoothed means, or others, as values."""
        return recording_graph(self._prior, self._moments, self._layouts, self.means() if means is None else means)

    def rough_means(self) -> list[FloatArray]:
        """Joint mean of every moment from which a solution can be found: the filter's, if it takes a good start."""
        if not self._nonlinear:
            return reckoned(self._prior, self._moments, self._layouts)
        self._passes = _completed(self._passes, self._prior, self._moments)
        return [state.filtered.mean for state in self._passes]

    def reweigh(self, moments: Sequence[Moment]) -> None:
        """Put moments in place that differ in the weights of their sightings only."""
        passes = [] if self._lazy else passed(self._prior, list(moments), self.means() if self._nonlinear else None)
        self._moments, self._passes = list(moments), passes
        self._converged = not self._nonlinear
        self._changed()

    def solve(self) -> None:
        """Complete the filter's pass; linearise until the smoothed means stand still where that makes a difference."""
        self._passes = _completed(self._passes, self._prior, self._moments)
        if self._converged:
            return
        means, step, iteration = smoothed_means(self._passes), math.inf, FixedPoint()
        ends = np.cumsum([len(mean) for mean in means])[:-1]
        for count in range(self._settings.max_iterations):
            passes = passed(self._prior, self._moments, means)
            solved = smoothed_means(passes)
            sigma = np.sqrt(np.concatenate([state.filtered.variances() for state in passes]))
            before, after = np.concatenate(means), np.concatenate(solved)
            step = float(np.max(np.abs(after - before) / sigma, initial=0.0))
            log.debug("iteration %d: largest step %.3g standard deviations", count + 1, step)
            if step <= self._settings.tolerance:
                break
            means = np.split(iteration.next(before, after, sigma), ends)
        else:
            log.warning("no convergence in %d iterations; last step %.2g sigma", self._settings.max_iterations, step)
        self._passes, self._converged = passes, True
        self._changed()
        self._means = solved

    def _move(self, motion: Motion | Standstill) -> None:
        moment, layout, passes = self._moments[-1], self.layout, self._passes
        if not self._lazy:
            self.solve()
        if not (self._lazy and motion.linear):
            known = _completed(self._passes, self._prior, self._moments)
            state, prior = known[-1].moved(moment.gone, motion)
            passes = [*known[:-1], state, arrival(prior)]
        self._moments = [*self._moments[:-1], replace(moment, motion=motion), Moment(moment.time + motion.dt)]
        self._layouts, self._passes = [*self._layouts, layout], passes
        self._nonlinear |= not motion.linear
        self._converged &= motion.linear or not self._lazy
        self._changed()

    def _moment_at(self, time: float) -> tuple[int, list[Moment], list[Layout]]:
        """The moment of `time`, with moments and layouts in which it is, an interval split if need be."""
        moments, layouts = list(self._moments), list(self._layouts)
        time = float(checked("time", time, ()))
        first, last = moments[0].time, moments[-1].time
        if time > last + _SAME_TIME:
            raise InputError(f"time: {time:.6f} s is after the newest moment, {last:.6f} s; predict first")
        if time < first - _SAME_TIME:
            raise InputError(f"time: {time:.6f} s is before what is remembered, which begins at {first:.6f} s")
        k = len(moments) - 1
        while moments[k].time > time + _SAME_TIME:
            k -= 1
        if moments[k].time >= time - _SAME_TIME:
            return k, moments, layouts
        motion = moments[k].motion
        assert isinstance(motion, Motion)  # a standstill has no inside
        start, rest = motion.parts(time - moments[k].time)
        gone = layouts[k].rows(moments[k].gone)
        moments[k] = replace(moments[k], motion=start)
        moments.insert(k + 1, Moment(time, motion=rest))
        layouts.insert(k + 1, layouts[k].without(gone) if len(gone) else layouts[k])
        return k + 1, moments, layouts

    def _changed(self) -> None:
        self._layout = None
        self._means = self._covariances = self._marginals = None


def _completed(passes: list[Pass], prior: BlockGaussian, moments: list[Moment]) -> list[Pass]:
    """The filter's pass over all moments, given that over the first ones."""
    k = len(passes)
    if k == len(moments):
        return passes
    done = list(passes)
    if k > 0:
        motion = moments[k - 1].motion
        assert motion is not None
        done[-1], prior = done[-1].moved(moments[k - 1].gone, motion)
    return done + passed(prior, moments[k:])

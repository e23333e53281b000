"""A record of epochs, with the filter over them, on which the smoothers are built.

A measurement of the past repeats the filter's pass from its time on. Where something is nonlinear or robust, all
of the record is linearised again (`saga_fg.estimators.backward`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError, require_type
from saga_fg.estimators.backward import (
    GaussNewtonSettings,
    MarginalCovariances,
    SmoothedCovariance,
    joint_covariances,
    relinearised,
    smoothed_marginals,
    smoothed_means,
)
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.epoch import (
    Epoch,
    FilterStep,
    NewNodes,
    completed,
    completed_within,
    dead_reckoned,
    filter_backwards,
    filter_epochs,
    initial_step,
    step_at,
)
from saga_fg.estimators.interval_dynamics import IntervalDynamics, ZeroInterval
from saga_fg.estimators.measurements import RecordedMeasurements
from saga_fg.estimators.object_factors import recording_graph
from saga_fg.estimators.partition import StateLayout, checked_prior
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.numerics.arrays import FloatArray, checked

_SAME_TIME = 1e-9  # s
MOST_KEPT = 200_000_000  # bytes of the filter's pass of a lazy recording


@dataclass(frozen=True, eq=False)
class RecordingState:
    """A recording as a value.

    prior of the first epoch; epochs; layout of each one's nodes; the filter's pass as far as it has come; whether
    everything is linearised where it should be
    """

    prior: BlockGaussian
    epochs: tuple[Epoch, ...]
    layouts: tuple[StateLayout, ...]
    steps: tuple[FilterStep, ...]
    converged: bool


class Recording:
    """Epochs in order of time, from 0 s on. Every method checks all it is given before it changes anything.

    With `lazy` the filter's pass waits until somebody asks for an estimate, or something nonlinear comes that must be
    tried; nobody learns the likelihoods meanwhile.
    """

    def __init__(self, settings: GaussNewtonSettings | None = None, lazy: bool = False) -> None:
        self._settings = settings or GaussNewtonSettings()
        self._lazy = lazy
        self._layout: StateLayout | None = None
        self._means: list[FloatArray] | None = None
        self._covariances: list[SmoothedCovariance] | None = None
        self._marginals: list[MarginalCovariances] | None = None
        nothing = BlockGaussian.empty()
        self.restore(RecordingState(nothing, (Epoch(0.0),), (nothing.layout,), (initial_step(nothing),), True))

    def __copy__(self) -> Recording:
        twin = Recording(self._settings, self._lazy)
        twin.restore(self.snapshot())
        return twin

    def snapshot(self) -> RecordingState:
        return RecordingState(
            self._prior, tuple(self._epochs), tuple(self._layouts), tuple(self._steps), self._converged
        )

    def restore(self, state: RecordingState) -> None:
        require_type("state", state, RecordingState)
        self._prior, self._converged = state.prior, state.converged
        self._epochs, self._layouts, self._steps = list(state.epochs), list(state.layouts), list(state.steps)
        self._nonlinear = not all(epoch.linear for epoch in state.epochs)
        self._clear_cache()

    @property
    def time(self) -> float:
        """Time of the newest epoch, s."""
        return self._epochs[-1].time

    @property
    def prior(self) -> BlockGaussian:
        """Gaussian before the first epoch, of the nodes of before."""
        return self._prior

    @property
    def epochs(self) -> Sequence[Epoch]:
        return self._epochs

    @property
    def linear(self) -> bool:
        """True where nothing is nonlinear or robust."""
        return not self._nonlinear

    @property
    def layouts(self) -> Sequence[StateLayout]:
        """Layout of each epoch's nodes, with those that leave afterwards."""
        return self._layouts

    @property
    def steps(self) -> Sequence[FilterStep]:
        """The filter's pass, complete and converged."""
        self.solve()
        return self._steps

    @property
    def layout(self) -> StateLayout:
        """Layout of the present nodes."""
        if self._layout is None:
            leaving = self._layouts[-1].rows(self._epochs[-1].leaving)
            self._layout = self._layouts[-1].without(leaving) if len(leaving) else self._layouts[-1]
        return self._layout

    def add(self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike) -> None:
        mean, covariance = checked_prior(nodes, means, covariances)
        added = self.layout.extended(nodes, mean.shape[1]).nodes[len(self.layout) :]
        if len(added) == 0:
            return
        if np.isin(added, self._epochs[-1].leaving).any():  # removed and added at the same time: another epoch
            self._begin_epoch(ZeroInterval())
        new, epoch = NewNodes(added, mean, covariance), self._epochs[-1]
        if len(self._steps) == len(self._epochs):
            self._steps[-1] = self._steps[-1].with_new_nodes(new)
        self._epochs[-1] = replace(epoch, new_nodes=(*epoch.new_nodes, new))
        self._layouts[-1] = self._layouts[-1].extended(added, mean.shape[1])
        self._clear_cache()

    def predict(self, interval: IntervalDynamics) -> None:
        """Begin a new epoch."""
        interval.check(self.layout)
        self._begin_epoch(interval)

    def update(self, recorded: RecordedMeasurements, time: float | None = None) -> float:
        """Take in measurements, of the newest epoch or of any `time` within the recording.

        Returns their log-likelihood given all that was known, NaN if lazy. An interval that contains `time` is split.
        """
        k, epochs, layouts = self._epoch_at(self.time if time is None else time)
        newest = k == len(epochs) - 1
        recorded.check(self.layout if newest else layouts[k])
        if len(recorded.measured) == 0:
            return 0.0
        inserted = len(epochs) > len(self._epochs)
        epochs[k] = replace(epochs[k], measurements=(*epochs[k].measurements, recorded))
        steps, likelihood = self._steps[:k], math.nan
        if not (self._lazy and recorded.linear):
            known = completed(self._steps, self._prior, self._epochs)
            steps = known[:k]
            if not inserted:
                steps.append(known[k].updated(recorded))
            steps = completed(steps, self._prior, epochs)
            if not self._lazy:
                likelihood = sum(step.log_likelihood for step in steps[k:])
                likelihood -= sum(step.log_likelihood for step in known[k:])
        elif newest and not inserted and len(self._steps) == len(epochs):
            steps.append(self._steps[k].updated(recorded))
        self._epochs, self._layouts, self._steps = epochs, layouts, steps
        self._nonlinear |= not recorded.linear
        self._converged = not self._nonlinear
        self._clear_cache()
        return likelihood

    def marginalise(self, nodes: ArrayLike) -> None:
        rows = self.layout.rows(nodes)
        if len(set(rows.tolist())) < len(rows):
            raise InputError("nodes: expected each node once")
        epoch = self._epochs[-1]
        self._epochs[-1] = replace(epoch, leaving=(*epoch.leaving, *self.layout.nodes[rows].tolist()))
        self._layout = None

    def drop(self, k: int) -> None:
        """Drop the first k epochs; their posterior becomes the prior."""
        if k == 0:
            return
        if not (self._lazy and self.linear):
            self.solve()
        if k < len(self._steps):
            self._prior = self._steps[k].prior
            self._steps = [replace(self._steps[k], carried=len(self._prior.layout)), *self._steps[k + 1 :]]
        else:
            self._prior, self._steps = step_at(self._prior, self._epochs, k).prior, []
        self._epochs = [replace(self._epochs[k], new_nodes=()), *self._epochs[k + 1 :]]
        self._layouts = self._layouts[k:]
        self._nonlinear = not all(epoch.linear for epoch in self._epochs)
        self._clear_cache()

    def latest(self) -> BlockGaussian:
        """The filter's posterior at the newest epoch, over all its nodes."""
        self.solve()
        return self._steps[-1].filtered

    def backwards(self) -> Iterator[FilterStep]:
        """The filter's pass, complete and converged, from the last epoch to the first.

        That of a lazy recording is not kept where it takes more than `MOST_KEPT` bytes.
        """
        if self._lazy and self.linear:
            steps = completed_within(self._steps, self._prior, self._epochs, MOST_KEPT)
            if steps is None:
                self._steps = []
                return filter_backwards(self._prior, self._epochs, MOST_KEPT)
            self._steps = steps
        return reversed(self.steps)

    def means(self) -> list[FloatArray]:
        """Smoothed joint mean of every epoch, over all its nodes (with those that leave afterwards)."""
        if self._means is None:
            steps = self.backwards()
            self._means = smoothed_means(steps) if self._means is None else self._means  # those of convergence
        return self._means

    def marginals(self) -> tuple[list[FloatArray], Sequence[MarginalCovariances]]:
        """Smoothed joint mean of every epoch, and covariances of its single nodes, which take little memory."""
        if self._marginals is None:
            self._means, self._marginals = smoothed_marginals(self.backwards())
        return self.means(), self._marginals

    def joint_covariances(self) -> Sequence[SmoothedCovariance]:
        """Smoothed joint covariance of every epoch."""
        if self._covariances is None:
            self._covariances = list(joint_covariances(self.steps))[::-1]
        return self._covariances

    def graph(self, means: Sequence[FloatArray] | None = None) -> SceneFactorGraph:
        """The equivalent factor graph, with the smoothed means, or others, as values."""
        return recording_graph(self._prior, self._epochs, self._layouts, self.means() if means is None else means)

    def rough_means(self) -> list[FloatArray]:
        """Joint mean of every epoch from which a solution can be found: the filter's, if it takes a good start."""
        if not self._nonlinear:
            return dead_reckoned(self._prior, self._epochs, self._layouts)
        self._steps = completed(self._steps, self._prior, self._epochs)
        return [step.filtered.mean for step in self._steps]

    def reweigh(self, epochs: Sequence[Epoch]) -> None:
        """Put epochs in place that differ in the weights of their measurements only."""
        steps = (
            [] if self._lazy else filter_epochs(self._prior, list(epochs), self.means() if self._nonlinear else None)
        )
        self._epochs, self._steps = list(epochs), steps
        self._converged = not self._nonlinear
        self._clear_cache()

    def solve(self) -> None:
        """Complete the filter's pass; linearise until the smoothed means stand still where that makes a difference."""
        self._steps = completed(self._steps, self._prior, self._epochs)
        if self._converged:
            return
        self._steps, means = relinearised(self._steps, self._prior, self._epochs, self._settings)
        self._converged = True
        self._clear_cache()
        self._means = means

    def _begin_epoch(self, interval: IntervalDynamics | ZeroInterval) -> None:
        epoch, layout, steps = self._epochs[-1], self.layout, self._steps
        if not self._lazy:
            self.solve()
        if not (self._lazy and interval.linear):
            known = completed(self._steps, self._prior, self._epochs)
            step, prior = known[-1].to_next(epoch.leaving, interval)
            steps = [*known[:-1], step, initial_step(prior)]
        self._epochs = [*self._epochs[:-1], replace(epoch, interval=interval), Epoch(epoch.time + interval.dt)]
        self._layouts, self._steps = [*self._layouts, layout], steps
        self._nonlinear |= not interval.linear
        self._converged &= interval.linear or not self._lazy
        self._clear_cache()

    def _epoch_at(self, time: float) -> tuple[int, list[Epoch], list[StateLayout]]:
        """The epoch of `time`, with epochs and layouts in which it is, an interval split if need be."""
        epochs, layouts = list(self._epochs), list(self._layouts)
        time = float(checked("time", time, ()))
        first, last = epochs[0].time, epochs[-1].time
        if time > last + _SAME_TIME:
            raise InputError(f"time: {time:.6f} s is after the newest epoch, {last:.6f} s; predict first")
        if time < first - _SAME_TIME:
            raise InputError(f"time: {time:.6f} s is before what is remembered, which begins at {first:.6f} s")
        k = len(epochs) - 1
        while epochs[k].time > time + _SAME_TIME:
            k -= 1
        if epochs[k].time >= time - _SAME_TIME:
            return k, epochs, layouts
        interval = epochs[k].interval
        assert isinstance(interval, IntervalDynamics)  # a zero interval has no inside
        start, rest = interval.split(time - epochs[k].time)
        leaving = layouts[k].rows(epochs[k].leaving)
        epochs[k] = replace(epochs[k], interval=start)
        epochs.insert(k + 1, Epoch(time, interval=rest))
        layouts.insert(k + 1, layouts[k].without(leaving) if len(leaving) else layouts[k])
        return k + 1, epochs, layouts

    def _clear_cache(self) -> None:
        self._layout = None
        self._means = self._covariances = self._marginals = None

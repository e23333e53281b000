"""The inputs of an estimator at an epoch, the filter's step there, and its pass over many.

An epoch is a time at which something was measured, or at which nodes appeared or went. It keeps the inputs (priors of
new nodes, measurements, nodes that leave, the interval to the next epoch), so that it can be filtered again: with late
measurements, or linearised at better estimates.

The filter's pass over epochs: forwards, and backwards in bounded memory.

Smoothing reads the pass from its end. A step takes the square of its components, so that a long recording, or one with
many tracks, does not keep them all: the priors of a few stretches are found first, and each stretch is filtered again
when its turn comes, itself in stretches if need be, with the same result to the last digit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.correction import Gain, correct
from saga_fg.estimators.dynamics import ComponentBounds, Dynamics, predict
from saga_fg.estimators.interval_dynamics import IntervalDynamics, ZeroInterval
from saga_fg.estimators.measurements import RecordedMeasurements
from saga_fg.estimators.partition import StateLayout
from saga_fg.numerics.arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class NewNodes:
    """Nodes that appear: ids (k,), means (k, d), covariances (k, d, d)."""

    nodes: IntArray
    means: FloatArray
    covariances: FloatArray


@dataclass(frozen=True, eq=False)
class Epoch:
    """time (s); new nodes, measurements, ids of the nodes that leave afterwards, interval to the next epoch."""

    time: float
    new_nodes: tuple[NewNodes, ...] = ()
    measurements: tuple[RecordedMeasurements, ...] = ()
    leaving: tuple[int, ...] = ()
    interval: IntervalDynamics | ZeroInterval | None = None

    @property
    def linear(self) -> bool:
        """True where linearising it again elsewhere changes nothing."""
        return (self.interval is None or self.interval.linear) and all(
            recorded.linear for recorded in self.measurements
        )


@dataclass(frozen=True, eq=False)
class FilterStep:
    """The filter at an epoch.

    carried     number of nodes from the epoch before; new ones stand behind them
    prior       before the measurements
    filtered    after the measurements
    gains       of the corrections, in order
    log_likelihood  of the innovations
    dynamics    to the next epoch, over the nodes that stay
    """

    carried: int
    prior: BlockGaussian
    filtered: BlockGaussian
    gains: tuple[Gain, ...] = ()
    log_likelihood: float = 0.0
    dynamics: Dynamics | None = None

    @property
    def layout(self) -> StateLayout:
        """All nodes of the epoch, with those that leave afterwards."""
        return self.filtered.layout

    @property
    def size(self) -> int:
        """Bytes of its covariances and gains, which grow with the square of components."""
        gains = [matrix for gain in self.gains for matrix in (gain.H, gain.L, gain.W)]
        return sum(matrix.nbytes for matrix in (*self.prior.blocks, *self.filtered.blocks, *gains))

    def with_new_nodes(self, new: NewNodes) -> FilterStep:
        """Add new nodes."""
        layout = self.layout.extended(new.nodes, new.means.shape[1])
        prior = self.prior.extended(layout, new.means, new.covariances)
        if not self.gains:
            return replace(self, prior=prior, filtered=prior)
        return replace(self, prior=prior, filtered=self.filtered.extended(layout, new.means, new.covariances))

    def updated(self, recorded: RecordedMeasurements, mean: FloatArray | None = None) -> FilterStep:
        """Take in measurements, linearised at the joint state `mean` (the filter's own for None)."""
        if len(recorded.measured) == 0:
            return self
        x = self.filtered
        rows = recorded.linearised(x.layout, x.mean if mean is None else mean)
        x, gains, log_likelihood = correct(x, *rows)
        return replace(
            self, filtered=x, gains=(*self.gains, *gains), log_likelihood=self.log_likelihood + log_likelihood
        )

    def staying(self, leaving: Sequence[int]) -> BlockGaussian:
        """The posterior of the nodes that stay."""
        return self.filtered.without(self.layout.rows(leaving))

    def to_next(
        self, leaving: Sequence[int], interval: IntervalDynamics | ZeroInterval, mean: FloatArray | None = None
    ) -> tuple[FilterStep, BlockGaussian]:
        """Set the dynamics to the next epoch, linearised at the joint state `mean`; returns also the prior there.

        Where a component would have more nodes than the interval allows, those that come last are inputs
        (`saga_fg.estimators.dynamics`), so that what is filtered, and smoothed, is exact for another linear model.
        """
        x = self.staying(leaving)
        at = x.mean
        if mean is not None:
            at = mean if len(mean) == len(at) else mean[self.layout.places(self.layout.rows(x.layout.nodes))]
        dynamics = interval.linearised(x.layout, at)
        if interval.most is not None and np.bincount(dynamics.joined(x.partition).label).max(initial=0) > interval.most:
            dynamics, partition = ComponentBounds(0.0, interval.most).applied(x, dynamics)
            return replace(self, dynamics=dynamics), predict(x, dynamics, partition)
        return replace(self, dynamics=dynamics), predict(dynamics.separated(x), dynamics)


def initial_step(prior: BlockGaussian) -> FilterStep:
    """The step of an epoch without events."""
    return FilterStep(len(prior.layout), prior, prior)


_PARTS = 4  # stretches


def dead_reckoned(prior: BlockGaussian, epochs: Sequence[Epoch], layouts: Sequence[StateLayout]) -> list[FloatArray]:
    """Joint means of every epoch by the dynamics alone, without measurements."""
    means, mean = [], prior.mean
    for epoch, layout in zip(epochs, layouts, strict=True):
        mean = np.concatenate([mean, *(new.means.ravel() for new in epoch.new_nodes)])
        means.append(mean)
        if epoch.interval is not None:
            leaving = layout.rows(epoch.leaving)
            stay = layout.without(leaving) if len(leaving) else layout
            before = mean[layout.places(layout.rows(stay.nodes))]
            dynamics = epoch.interval.linearised(stay, before)
            mean = dynamics.times(before) + dynamics.b
    return means


def filter_epochs(
    prior: BlockGaussian, epochs: Sequence[Epoch], means: Sequence[FloatArray] | None = None
) -> list[FilterStep]:
    """Filter `epochs` from a prior; linearised at joint states `means` if given."""
    return [step for step, _ in _filtered(prior, epochs, means)]


def completed(steps: list[FilterStep], prior: BlockGaussian, epochs: Sequence[Epoch]) -> list[FilterStep]:
    """The pass over all epochs, given that over the first ones."""
    return [*_continued(steps, prior, epochs)]


def completed_within(
    steps: list[FilterStep], prior: BlockGaussian, epochs: Sequence[Epoch], most: int
) -> list[FilterStep] | None:
    """The pass over all epochs, given that over the first ones; None where it takes more than `most` bytes."""
    done, size = [], 0
    for step in _continued(steps, prior, epochs):
        done.append(step)
        size += step.size
        if size > most:
            return None
    return done


def step_at(prior: BlockGaussian, epochs: Sequence[Epoch], k: int) -> FilterStep:
    """The step of epoch k, no other being kept."""
    for step, _ in _filtered(prior, epochs[: k + 1]):
        latest = step
    return latest


def filter_backwards(prior: BlockGaussian, epochs: Sequence[Epoch], most: int) -> Iterator[FilterStep]:
    """The steps from the last to the first, of which about `most` bytes are kept, and a few priors."""
    steps = filter_epochs(prior, epochs) if len(epochs) == 1 else completed_within([], prior, epochs, most)
    if steps is not None:
        while steps:
            yield steps.pop()
        return
    length = math.ceil(len(epochs) / _PARTS)
    begins, priors = range(0, len(epochs), length), [prior]
    for k, (_, after) in enumerate(_filtered(prior, epochs[: begins[-1]])):
        if k + 1 in begins:
            priors.append(after)
    for begin in reversed(begins):
        yield from filter_backwards(priors.pop(), epochs[begin : begin + length], most)


def _continued(steps: list[FilterStep], prior: BlockGaussian, epochs: Sequence[Epoch]) -> Iterator[FilterStep]:
    k = len(steps)
    if 0 < k < len(epochs):
        interval = epochs[k - 1].interval
        assert interval is not None
        last, prior = steps[-1].to_next(epochs[k - 1].leaving, interval)
        steps = [*steps[:-1], last]
    yield from steps
    for step, _ in _filtered(prior, epochs[k:]):
        yield step


def _filtered(
    prior: BlockGaussian, epochs: Sequence[Epoch], means: Sequence[FloatArray] | None = None
) -> Iterator[tuple[FilterStep, BlockGaussian]]:
    """The step of each epoch, and the prior of the next."""
    for k, epoch in enumerate(epochs):
        mean = None if means is None else means[k]
        step = initial_step(prior)
        for new in epoch.new_nodes:
            step = step.with_new_nodes(new)
        for recorded in epoch.measurements:
            step = step.updated(recorded, mean)
        if epoch.interval is not None:
            step, prior = step.to_next(epoch.leaving, epoch.interval, mean)
        yield step, prior

"""The inputs of an estimator, epoch by epoch, and the filter over them.

An epoch is a time at which something was measured, or at which nodes appeared or went. It keeps the inputs (priors of
new nodes, measurements, nodes that leave, the interval to the next epoch), so that it can be filtered again: with late
measurements, or linearised at better estimates.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.correction import Gain, correct
from saga_fg.estimators.dynamics import Dynamics, predict
from saga_fg.estimators.interval_dynamics import IntervalDynamics, ZeroInterval
from saga_fg.estimators.layout import StateLayout
from saga_fg.estimators.measurements import RecordedMeasurements
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
        """Set the dynamics to the next epoch, linearised at the joint state `mean`; returns also the prior there."""
        x = self.staying(leaving)
        at = x.mean
        if mean is not None:
            at = mean if len(mean) == len(at) else mean[self.layout.places(self.layout.rows(x.layout.nodes))]
        dynamics = interval.linearised(x.layout, at)
        return replace(self, dynamics=dynamics), predict(dynamics.separated(x), dynamics)


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


def initial_step(prior: BlockGaussian) -> FilterStep:
    """The step of an epoch without events."""
    return FilterStep(len(prior.layout), prior, prior)


def filter_epochs(
    prior: BlockGaussian, epochs: Sequence[Epoch], means: Sequence[FloatArray] | None = None
) -> list[FilterStep]:
    """Filter `epochs` from a prior; linearised at joint states `means` if given."""
    return [step for step, _ in _filtered(prior, epochs, means)]


def filter_backwards(prior: BlockGaussian, epochs: Sequence[Epoch], most: int) -> Iterator[FilterStep]:
    """Filter `epochs` from a prior, and give the steps from the last to the first.

    No more are kept than those of a stretch of about `most` states: where there are more, the priors of all stretches
    are found first, and each is filtered again when its turn comes, with the same result to the last digit.
    """
    priors, ends, states, steps = [prior], [0], 0, list[FilterStep]()
    for k, (step, after) in enumerate(_filtered(prior, epochs)):
        steps.append(step)
        states += len(step.layout)
        if states >= most and k + 1 < len(epochs):
            priors.append(after)
            ends.append(k + 1)
            states, steps = 0, []
    while steps:
        yield steps.pop()
    for number in range(len(ends) - 2, -1, -1):
        steps = filter_epochs(priors[number], epochs[ends[number] : ends[number + 1]])
        while steps:
            yield steps.pop()


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

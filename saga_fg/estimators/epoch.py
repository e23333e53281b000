"""The record of what an estimator was told, epoch by epoch, and the filter's pass over it.

An epoch is a time at which something was measured, or at which nodes appeared or went. It keeps the inputs (priors of
new nodes, measurements, which nodes go, the motion to the next epoch), so that the pass can be done again: with a late
measurement, or linearised at better estimates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.correction import Gain, correct
from saga_fg.estimators.dynamics import Dynamics, predict
from saga_fg.estimators.layout import Layout
from saga_fg.estimators.measurements import RecordedMeasurements
from saga_fg.estimators.motion import Motion, Standstill
from saga_fg.numerics.arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Birth:
    """Nodes that appear: ids (k,), means (k, d), covariances (k, d, d)."""

    nodes: IntArray
    means: FloatArray
    covariances: FloatArray


@dataclass(frozen=True, eq=False)
class Epoch:
    """time (s); nodes that appear, what is seen, ids of the nodes that go afterwards, motion to the next epoch."""

    time: float
    births: tuple[Birth, ...] = ()
    measurements: tuple[RecordedMeasurements, ...] = ()
    gone: tuple[int, ...] = ()
    motion: Motion | Standstill | None = None

    @property
    def linear(self) -> bool:
        """Whether linearising it again elsewhere gives the same."""
        return (self.motion is None or self.motion.linear) and all(recorded.linear for recorded in self.measurements)


@dataclass(frozen=True, eq=False)
class FilterStep:
    """What the filter made of an epoch.

    carried     number of nodes that were there before; those that appear stand behind them
    prior     before anything is seen
    filtered    after everything is seen
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
    def layout(self) -> Layout:
        """All nodes of the epoch, those that go afterwards too."""
        return self.filtered.layout

    def with_birth(self, birth: Birth) -> FilterStep:
        """With nodes that appear."""
        layout = self.layout.extended(birth.nodes, birth.means.shape[1])
        prior = self.prior.extended(layout, birth.means, birth.covariances)
        if not self.gains:
            return replace(self, prior=prior, filtered=prior)
        return replace(self, prior=prior, filtered=self.filtered.extended(layout, birth.means, birth.covariances))

    def updated(self, recorded: RecordedMeasurements, mean: FloatArray | None = None) -> FilterStep:
        """With measurements taken in, linearised at the joint state `mean` (the filter's own for None)."""
        if len(recorded.measured) == 0:
            return self
        x = self.filtered
        rows = recorded.linearised(x.layout, x.mean if mean is None else mean)
        x, gains, log_likelihood = correct(x, *rows)
        return replace(
            self, filtered=x, gains=(*self.gains, *gains), log_likelihood=self.log_likelihood + log_likelihood
        )

    def staying(self, gone: Sequence[int]) -> BlockGaussian:
        """The posterior of the nodes that stay."""
        return self.filtered.without(self.layout.rows(gone))

    def to_next(
        self, gone: Sequence[int], motion: Motion | Standstill, mean: FloatArray | None = None
    ) -> tuple[FilterStep, BlockGaussian]:
        """With the dynamics to the next epoch, linearised at the joint state `mean`; and the prior they lead to."""
        x = self.staying(gone)
        at = x.mean
        if mean is not None:
            at = mean if len(mean) == len(at) else mean[self.layout.places(self.layout.rows(x.layout.nodes))]
        dynamics = motion.dynamics(x.layout, at)
        return replace(self, dynamics=dynamics), predict(dynamics.separated(x), dynamics)


def dead_reckoned(prior: BlockGaussian, epochs: Sequence[Epoch], layouts: Sequence[Layout]) -> list[FloatArray]:
    """Joint means of every epoch by the dynamics alone, whatever was seen."""
    means, mean = [], prior.mean
    for epoch, layout in zip(epochs, layouts, strict=True):
        mean = np.concatenate([mean, *(birth.means.ravel() for birth in epoch.births)])
        means.append(mean)
        if epoch.motion is not None:
            gone = layout.rows(epoch.gone)
            stay = layout.without(gone) if len(gone) else layout
            before = mean[layout.places(layout.rows(stay.nodes))]
            dynamics = epoch.motion.dynamics(stay, before)
            mean = dynamics.moved(before) + dynamics.b
    return means


def initial_step(prior: BlockGaussian) -> FilterStep:
    """The pass of an epoch at which nothing has happened yet."""
    return FilterStep(len(prior.layout), prior, prior)


def filter_epochs(prior: BlockGaussian, epochs: list[Epoch], means: list[FloatArray] | None = None) -> list[FilterStep]:
    """The filter's pass over `epochs` from what is known before; linearised at joint states `means` if given."""
    steps = []
    for k, epoch in enumerate(epochs):
        mean = None if means is None else means[k]
        step = initial_step(prior)
        for birth in epoch.births:
            step = step.with_birth(birth)
        for recorded in epoch.measurements:
            step = step.updated(recorded, mean)
        if epoch.motion is not None:
            step, prior = step.to_next(epoch.gone, epoch.motion, mean)
        steps.append(step)
    return steps

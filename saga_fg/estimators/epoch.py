"""The inputs of an estimator at an epoch, and the filter's step there.

An epoch is a time at which something was measured, or at which nodes appeared or went. It keeps the inputs (priors of
new nodes, measurements, nodes that leave, the interval to the next epoch), so that it can be filtered again: with late
measurements, or linearised at better estimates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.bounds import ComponentBounds
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
        (`saga_fg.estimators.bounds`), so that what is filtered, and smoothed, is exact for another linear model.
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

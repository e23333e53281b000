"""The record of what an estimator was told, moment by moment, and the filter's pass over it.

A moment is a time at which something was measured, or at which nodes appeared or went. It keeps the inputs (priors of
new nodes, sightings, which nodes go, the motion to the next moment), so that the pass can be done again: with a late
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
from saga_fg.estimators.motion import Motion, Standstill
from saga_fg.estimators.sighting import Sighting
from saga_fg.numerics.arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Birth:
    """Nodes that appear: ids (k,), means (k, d), covariances (k, d, d)."""

    nodes: IntArray
    means: FloatArray
    covariances: FloatArray


@dataclass(frozen=True, eq=False)
class Moment:
    """time (s); nodes that appear, what is seen, ids of the nodes that go afterwards, motion to the next moment."""

    time: float
    births: tuple[Birth, ...] = ()
    sightings: tuple[Sighting, ...] = ()
    gone: tuple[int, ...] = ()
    motion: Motion | Standstill | None = None

    @property
    def linear(self) -> bool:
        """Whether linearising it again elsewhere gives the same."""
        return (self.motion is None or self.motion.linear) and all(sighting.linear for sighting in self.sightings)


@dataclass(frozen=True, eq=False)
class Pass:
    """What the filter made of a moment.

    carried     number of nodes that were there before; those that appear stand behind them
    arrived     before anything is seen
    filtered    after everything is seen
    gains       of the corrections, in order
    log_likelihood  of the innovations
    dynamics    to the next moment, over the nodes that stay
    """

    carried: int
    arrived: BlockGaussian
    filtered: BlockGaussian
    gains: tuple[Gain, ...] = ()
    log_likelihood: float = 0.0
    dynamics: Dynamics | None = None

    @property
    def layout(self) -> Layout:
        """All nodes of the moment, those that go afterwards too."""
        return self.filtered.layout

    def born(self, birth: Birth) -> Pass:
        """With nodes that appear."""
        layout = self.layout.extended(birth.nodes, birth.means.shape[1])
        arrived = self.arrived.extended(layout, birth.means, birth.covariances)
        if not self.gains:
            return replace(self, arrived=arrived, filtered=arrived)
        return replace(self, arrived=arrived, filtered=self.filtered.extended(layout, birth.means, birth.covariances))

    def seen(self, sighting: Sighting, mean: FloatArray | None = None) -> Pass:
        """With measurements taken in, linearised at the joint state `mean` (the filter's own for None)."""
        if len(sighting.measured) == 0:
            return self
        x = self.filtered
        rows = sighting.linearised(x.layout, x.mean if mean is None else mean)
        x, gains, log_likelihood = correct(x, *rows)
        return replace(
            self, filtered=x, gains=(*self.gains, *gains), log_likelihood=self.log_likelihood + log_likelihood
        )

    def staying(self, gone: Sequence[int]) -> BlockGaussian:
        """The posterior of the nodes that stay."""
        return self.filtered.without(self.layout.rows(gone))

    def moved(
        self, gone: Sequence[int], motion: Motion | Standstill, mean: FloatArray | None = None
    ) -> tuple[Pass, BlockGaussian]:
        """With the dynamics to the next moment, linearised at the joint state `mean`; and the prior they lead to."""
        x = self.staying(gone)
        at = x.mean
        if mean is not None:
            at = mean if len(mean) == len(at) else mean[self.layout.places(self.layout.rows(x.layout.nodes))]
        dynamics = motion.dynamics(x.layout, at)
        return replace(self, dynamics=dynamics), predict(dynamics.separated(x), dynamics)


def reckoned(prior: BlockGaussian, moments: Sequence[Moment], layouts: Sequence[Layout]) -> list[FloatArray]:
    """Joint means of every moment by the dynamics alone, whatever was seen."""
    means, mean = [], prior.mean
    for moment, layout in zip(moments, layouts, strict=True):
        mean = np.concatenate([mean, *(birth.means.ravel() for birth in moment.births)])
        means.append(mean)
        if moment.motion is not None:
            gone = layout.rows(moment.gone)
            stay = layout.without(gone) if len(gone) else layout
            before = mean[layout.places(layout.rows(stay.nodes))]
            dynamics = moment.motion.dynamics(stay, before)
            mean = dynamics.moved(before) + dynamics.b
    return means


def arrival(prior: BlockGaussian) -> Pass:
    """The pass of a moment at which nothing has happened yet."""
    return Pass(len(prior.layout), prior, prior)


def passed(prior: BlockGaussian, moments: list[Moment], means: list[FloatArray] | None = None) -> list[Pass]:
    """The filter's pass over `moments` from what is known before; linearised at joint states `means` if given."""
    passes = []
    for k, moment in enumerate(moments):
        mean = None if means is None else means[k]
        state = arrival(prior)
        for birth in moment.births:
            state = state.born(birth)
        for sighting in moment.sightings:
            state = state.seen(sighting, mean)
        if moment.motion is not None:
            state, prior = state.moved(moment.gone, moment.motion, mean)
        passes.append(state)
    return passes

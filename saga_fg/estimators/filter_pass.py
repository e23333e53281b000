"""The filter's pass over epochs: forwards, and backwards in bounded memory.

Smoothing reads the pass from its end. A step takes the square of its components, so that a long recording, or one with
many tracks, does not keep them all: the priors of a few stretches are found first, and each stretch is filtered again
when its turn comes, itself in stretches if need be, with the same result to the last digit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.epoch import Epoch, FilterStep, initial_step
from saga_fg.estimators.layout import StateLayout
from saga_fg.numerics.arrays import FloatArray

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

"""Gauss-Newton over a recording: linearised at the smoothed means until they converge.

Source: Bell, The iterated Kalman smoother as a Gauss-Newton method, SIAM J. Optimization 4 (1994).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from saga_fg.errors import InputError
from saga_fg.estimators.anderson import AndersonAcceleration
from saga_fg.estimators.backward import smoothed_means
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.epoch import Epoch, FilterStep
from saga_fg.estimators.filter_pass import filter_epochs
from saga_fg.numerics.arrays import FloatArray
from saga_fg.settings import setting

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class GaussNewtonSettings:
    """Settings of Gauss-Newton over a recording."""

    max_iterations: int = setting(100, "largest number of linearisations of the whole recording")
    tolerance: float = setting(1e-9, "largest step of a mean at convergence, standard deviations")

    def __post_init__(self) -> None:
        if self.max_iterations < 1:
            raise InputError(f"max_iterations: expected at least 1, got {self.max_iterations}")
        if not self.tolerance > 0:
            raise InputError(f"tolerance: expected a positive number, got {self.tolerance}")


def relinearised(
    steps: Sequence[FilterStep], prior: BlockGaussian, epochs: Sequence[Epoch], settings: GaussNewtonSettings
) -> tuple[list[FilterStep], list[FloatArray]]:
    """The converged filter's pass and smoothed means, from a first pass."""
    means, step, iteration = smoothed_means(reversed(steps)), math.inf, AndersonAcceleration()
    ends = np.cumsum([len(mean) for mean in means])[:-1]
    for count in range(settings.max_iterations):
        found = filter_epochs(prior, epochs, means)
        solved = smoothed_means(reversed(found))
        sigma = np.sqrt(np.concatenate([step.filtered.variances() for step in found]))
        before, after = np.concatenate(means), np.concatenate(solved)
        step = float(np.max(np.abs(after - before) / sigma, initial=0.0))
        log.debug("iteration %d: largest step %.3g standard deviations", count + 1, step)
        if step <= settings.tolerance:
            break
        means = np.split(iteration.next(before, after, sigma), ends)
    else:
        log.warning("no convergence in %d iterations; last step %.2g sigma", settings.max_iterations, step)
    return found, solved

"""Process and position noise of the independent filter by the likelihood of positions after gaps.

The likelihood is that of `gap_prediction` without edges. It is evaluated on a grid once for each recording, so that the
maximum over any set of recordings is cheap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from saga_fg.learning.gap_prediction import negative_log_likelihood, predict_gaps
from saga_fg.learning.gaps import GapSettings, sample_gaps
from saga_fg.learning.independent_filter import FilteredTrajectories, filter_independently
from saga_fg.learning.trajectories import Trajectories
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.by_class import DEFAULT, class_numbers

ACCELERATION_NOISE = tuple(np.geomspace(0.003, 3.0, 7).tolist())  # m^2/s^3
POSITION_NOISE = (0.01, 0.02, 0.05, 0.1, 0.2)  # m


class FilterNoiseLikelihood:
    """Likelihoods of one recording: for each class, `loss` (Q, R), the sum over its gaps, and their `count`."""

    def __init__(self, trajectories: Trajectories, classes: tuple[str, ...], settings: GapSettings) -> None:
        self.loss = {c: np.zeros((len(ACCELERATION_NOISE), len(POSITION_NOISE))) for c in classes}
        self.count = dict.fromkeys(classes, 0)
        settings = replace(settings, neighbours=1)  # not used without edges
        for i, q in enumerate(ACCELERATION_NOISE):
            for j, r in enumerate(POSITION_NOISE):
                filtered = filter_independently(trajectories, np.full(len(trajectories.label), q), r)
                sample = sample_gaps(trajectories, filtered, classes, settings)
                for c in classes:
                    of_class = sample.select(np.flatnonzero(sample.label == c))
                    if len(of_class):
                        prediction = predict_gaps(of_class, lambda _features, _seen: [], q, 0.0)
                        known = int(np.isfinite(of_class.measured[..., 0]).sum())
                        self.loss[c][i, j] = known * negative_log_likelihood(of_class, prediction, r)
                        self.count[c] = len(of_class)


@dataclass(frozen=True)
class FilterNoise:
    """acceleration_noise by class, m^2/s^3, `default` for all others; position_noise, m."""

    acceleration_noise: dict[str, float]
    position_noise: float

    @classmethod
    def most_likely(cls, likelihoods: Sequence[FilterNoiseLikelihood]) -> FilterNoise:
        """Maximise the likelihood of some recordings: one position noise, and a process noise for every class."""
        classes = list(likelihoods[0].loss)
        losses = {c: np.sum([of.loss[c] for of in likelihoods], axis=0) for c in classes}
        best: FloatArray = np.sum([loss.min(axis=0) for loss in losses.values()], axis=0)
        r = int(np.argmin(best))
        noise = {c: ACCELERATION_NOISE[int(np.argmin(loss[:, r]))] for c, loss in losses.items() if loss.any()}
        together: FloatArray = np.sum(list(losses.values()), axis=0)
        return cls({**noise, DEFAULT: ACCELERATION_NOISE[int(np.argmin(together[:, r]))]}, POSITION_NOISE[r])

    def filtered(self, trajectories: Trajectories) -> FilteredTrajectories:
        """The trajectories, filtered with this noise."""
        noise = class_numbers(self.acceleration_noise, float, trajectories.label)
        return filter_independently(trajectories, noise, self.position_noise)

r"""The probability r that a track is a real object, by Bayes' rule.

    miss    r <- r (1 - p_D) / (1 - r p_D) exp(-dt / lifetime)
    match   r / (1 - r) <- r / (1 - r)  p / (1 - p)  (1 - c) / c

    score   p ( hits / (looks + prior_opportunities) )^w    when detected; else times r and coasting_score_factor

p_D is the chance to be detected where the track is (0 where no sensor looks), p the detection's probability, and c the
one at which a detection says nothing. Source: Musicki, Evans, Stankovic, Integrated Probabilistic Data Association,
IEEE Transactions on Automatic Control 39(6), 1994.
"""

from __future__ import annotations

import math

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.tracking.columns import TrackColumns
from saga_fg.tracking.settings import ExistenceSettings


def after_miss(existence: FloatArray, p_detect: FloatArray, elapsed: float, settings: ExistenceSettings) -> FloatArray:
    """Existence (k,) of tracks that no detection was found for, `elapsed` s after the last look."""
    missed = existence * (1 - p_detect) / np.maximum(1 - existence * p_detect, 1e-9)
    return np.asarray(missed * math.exp(-elapsed / settings.lifetime))


def after_hit(existence: FloatArray, probability: FloatArray, settings: ExistenceSettings) -> FloatArray:
    """Existence (k,) of tracks that took in a detection of some `probability` (k,)."""
    odds = probability / (1 - probability) * (1 - settings.neutral_score) / settings.neutral_score
    before = np.clip(existence, 1e-3, 1 - 1e-3)
    after = before / (1 - before) * odds
    return np.clip(after / (1 + after), 0.0, 0.999)


def reported_score(columns: TrackColumns, coasting: BoolArray, settings: ExistenceSettings) -> FloatArray:
    """(n,) how sure a track's box is: by its latest detection, by how steadily it is detected, less while coasting."""
    steadiness = (columns.hits / (columns.looks + settings.prior_opportunities)) ** settings.hit_ratio_weight
    unseen = columns.existence * settings.coasting_score_factor
    return np.asarray(columns.score * steadiness * np.where(coasting, unseen, 1.0))

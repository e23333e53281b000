"""Percentiles of latencies in bounded memory: a histogram whose bins widen by 2 %."""

from __future__ import annotations

import math

import numpy as np

SHORTEST = 1e-6  # s
GROWTH = 1.02
BINS = 1200  # up to hours


class Latencies:
    """Counts durations; percentiles are exact to 1 %."""

    def __init__(self) -> None:
        self._counts = np.zeros(BINS, dtype=np.int64)

    def add(self, seconds: float) -> None:
        """Count a duration."""
        bin_ = int(math.log(max(seconds, SHORTEST) / SHORTEST) / math.log(GROWTH))
        self._counts[min(bin_, BINS - 1)] += 1

    def __len__(self) -> int:
        return int(self._counts.sum())

    def percentile(self, percent: float) -> float:
        """Return the percentile of the durations, s; NaN if there is none."""
        total = len(self)
        if total == 0:
            return math.nan
        bin_ = int(np.searchsorted(np.cumsum(self._counts), percent / 100 * total))
        return float(SHORTEST * GROWTH ** (min(bin_, BINS - 1) + 0.5))

"""Intervals of differences in figures that are computed anew for every sampled set of scenes, such as AMOTA.

Scenes are sampled with replacement, the same for both; the interval is the percentile interval of the differences.
`data_tools.metrics.paired_bootstrap` does the same for figures that follow from sums over scenes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from data_tools.metrics import Interval

FiguresOf = Callable[[Sequence[int]], Mapping[str, float]]  # of some scenes, by their numbers, which may repeat


def sampled_differences(
    first: FiguresOf, second: FiguresOf, scenes: int, draws: int, seed: int = 0, confidence: float = 0.95
) -> dict[str, Interval]:
    """First less second over `scenes` scenes in each figure that both have, with its interval."""
    rng = np.random.default_rng(seed)
    sampled: dict[str, list[float]] = {}
    for _ in range(draws):
        rows = rng.integers(scenes, size=scenes).tolist()
        a, b = first(rows), second(rows)
        for name in a:
            if name in b:
                sampled.setdefault(name, []).append(a[name] - b[name])
    tail = (1 - confidence) / 2
    ours, theirs = first(range(scenes)), second(range(scenes))
    result = {}
    for name, values in sampled.items():
        known = [value for value in values if math.isfinite(value)]
        if name in ours and name in theirs and known:
            low, high = np.quantile(known, [tail, 1 - tail]).tolist()
            result[name] = Interval(ours[name] - theirs[name], low, high, confidence)
    return result

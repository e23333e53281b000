"""How sure a difference in figures is that must be taken anew of every drawn set of scenes, such as AMOTA.

Scenes are drawn with replacement, the same for both; the interval is that of the percentiles of the differences.
`data_tools.metrics.paired_bootstrap` does the same for figures that follow from sums over scenes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from data_tools.metrics import Interval

FiguresOf = Callable[[Sequence[int]], Mapping[str, float]]  # of some scenes, by their numbers, which may repeat


def drawn_differences(
    first: FiguresOf, second: FiguresOf, scenes: int, draws: int, seed: int = 0, confidence: float = 0.95
) -> dict[str, Interval]:
    """First less second over `scenes` scenes in each figure that both have, with its interval."""
    rng = np.random.default_rng(seed)
    drawn: dict[str, list[float]] = {}
    for _ in range(draws):
        rows = rng.integers(scenes, size=scenes).tolist()
        a, b = first(rows), second(rows)
        for name in a:
            if name in b:
                drawn.setdefault(name, []).append(a[name] - b[name])
    tail = (1 - confidence) / 2
    ours, theirs = first(range(scenes)), second(range(scenes))
    result = {}
    for name, values in drawn.items():
        known = [value for value in values if math.isfinite(value)]
        if name in ours and name in theirs and known:
            low, high = np.quantile(known, [tail, 1 - tail]).tolist()
            result[name] = Interval(ours[name] - theirs[name], low, high, confidence)
    return result

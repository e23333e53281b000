"""The mean score of each track, run after run, to the last bit.

The reference evaluation replaces the score of every box by the mean over its track, and does so again before each
further run. The mean of n equal numbers, added up one after the other, need not be that number in its last bit; and
since every threshold *is* the score of some track, that track then fails its own threshold or passes it. With few
tracks this changes the averages by whole points, so results are comparable only if the rounding is repeated.
"""

from __future__ import annotations

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray


def track_scores(score: FloatArray, identity: IntArray, runs: int) -> FloatArray:
    """(N, runs): the score of each row's track in each run, from the scores (N,) and tracks `identity` (N,) of rows."""
    length = np.bincount(identity)
    mean = np.bincount(identity, weights=score) / length  # adds up one after the other
    columns = [mean]
    for _ in range(runs - 1):
        columns.append(_mean_of_equals(columns[-1], length))
    return np.stack(columns, axis=1)[identity]


def _mean_of_equals(value: FloatArray, count: IntArray) -> FloatArray:
    """`count` (K,) times the same `value` (K,), added up one after the other and divided by `count`."""
    steps = int(count.max(initial=1))
    partial = np.add.accumulate(np.broadcast_to(value, (steps, len(value))), axis=0)
    return np.asarray(partial[count - 1, np.arange(len(value))] / count)

"""Duplicate tracks: one that is not seen, where another of its class is seen, is most often the same object.

Two that are both detected in a frame are two objects (`saga_fg.tracking.suppression` has seen to that). Of two of which
one is detected, the other ends: it is marginalised, so that what it knew of its neighbours stays with them.
"""

from __future__ import annotations

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, StrArray


def duplicates(position: FloatArray, label: StrArray, seen: BoolArray, distance: FloatArray) -> BoolArray:
    """Which tracks (n,) are not seen and closer than their `distance` (n,), m, to a seen one of their class.

    position (n, 2), label (n,), seen (n,): detected in the latest frame
    """
    result = np.zeros(len(label), dtype=bool)
    unseen, there = np.flatnonzero(~seen & (distance > 0)), np.flatnonzero(seen)
    apart = np.hypot(*np.moveaxis(position[unseen, None] - position[there], -1, 0))
    same = (apart < distance[unseen, None]) & (label[unseen, None] == label[there])
    result[unseen[same.any(axis=1)]] = True
    return result

"""Coverage of each object over time, at all thresholds at once: tracked share, fragments, delays and gaps.

    ratio   frames with a track / frames of the object       mostly tracked: >= 0.8, mostly lost: < 0.2
    FRAG    changes from tracked to missed between the first and the last tracked frame
    TID     time from the first frame to the first tracked one
    LGD     longest run of missed frames, before the first and after the last tracked one included

TID and LGD are means over the objects that are tracked at all, NaN if there is none; a frame counts as one sample
period. Source: nuScenes tracking task, https://www.nuscenes.org/tracking.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class TrackCoverage:
    """Coverage of the objects of one class at T thresholds, each (T,)."""

    mostly_tracked: IntArray
    mostly_lost: IntArray
    fragments: IntArray
    initialisation: FloatArray
    longest_gap: FloatArray


def track_coverage(tracked: BoolArray, identity: IntArray, period: float) -> TrackCoverage:
    """Coverage from `tracked` (N, T), whose rows are sorted by `identity` (N,), then time; `period` in s. N > 0."""
    start = np.flatnonzero(np.diff(identity, prepend=identity[0] - 1))
    length = np.diff(start, append=len(identity))
    owner = np.repeat(np.arange(len(start)), length)
    row = np.arange(len(identity))[:, None]
    ratio = np.add.reduceat(tracked, start, axis=0, dtype=np.int64) / length[:, None]
    ever = ratio > 0
    first = np.minimum.reduceat(np.where(tracked, row, len(identity)), start, axis=0)
    last = np.maximum.reduceat(np.where(tracked, row, -1), start, axis=0)
    dropped = np.zeros_like(tracked)
    dropped[1:] = tracked[:-1] & ~tracked[1:] & (owner[1:] == owner[:-1])[:, None] & (row[1:] < last[owner[1:]])
    begins = np.zeros((len(identity), 1), dtype=np.bool_)
    begins[start] = True
    # The run of misses that ends at a row reaches back to the last tracked row, or to before the object's first.
    anchor = np.maximum.accumulate(np.where(tracked, row, np.where(begins, row - 1, -1)), axis=0)
    longest = np.maximum.reduceat(row - anchor, start, axis=0)
    objects = ever.sum(axis=0)
    with np.errstate(invalid="ignore"):
        initialisation = period * np.where(ever, first - start[:, None], 0).sum(axis=0) / objects
        longest_gap = period * np.where(ever, longest, 0).sum(axis=0) / objects
    return TrackCoverage(
        (ratio >= 0.8).sum(axis=0), (ratio < 0.2).sum(axis=0), dropped.sum(axis=0), initialisation, longest_gap
    )

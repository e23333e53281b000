"""Identity switches, fragments and coverage of true trajectories, counted as the KITTI benchmark counts them.

With g(f) the track matched in the object's f-th frame, -1 for none, and `last` the latest track of an earlier frame,
forgotten at frames in which the object does not count:

    switch    last != g(f), and last, g(f), g(f - 1) are all tracks
    fragment  g(f) != g(f - 1), and last, g(f), g(f + 1) are all tracks; in the last frame: g(f) != g(f - 1), a track

A trajectory that never counts is left out. Mostly tracked: in over 0.8 of the frames that count; mostly lost: in under
0.2 of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class TrajectoryCounts:
    """Each (T,), at T thresholds: numbers of switches and fragments, shares of trajectories."""

    switches: IntArray
    fragments: IntArray
    mostly_tracked: FloatArray
    mostly_lost: FloatArray


def trajectory_counts(track: IntArray, identity: IntArray, exempt: BoolArray) -> TrajectoryCounts:
    """Counts for `track` (N, T), the track matched to each row or -1, rows sorted by `identity` (N,), then frame.

    exempt (N,): rows in which the object is exempt. N > 0.
    """
    start = np.flatnonzero(np.diff(identity, prepend=identity[0] - 1))
    length = np.diff(start, append=len(identity))
    first = np.zeros((len(identity), 1), dtype=np.bool_)
    first[start] = True
    final = np.roll(first, -1)
    counts = ~exempt[:, None]
    matched = track >= 0
    before, after = np.roll(track, 1, axis=0), np.roll(track, -1, axis=0)

    row = np.arange(len(identity))[:, None]
    remembers = np.where(first | counts & matched | ~counts, row, 0)  # rows that set the memory, or clear it
    source = np.roll(np.maximum.accumulate(remembers, axis=0), 1, axis=0)
    memory = np.where(counts | first, track, -1)
    last = np.where(first, -1, np.take_along_axis(memory, source, axis=0))

    evaluated = counts & ~first & matched
    switch = evaluated & (last >= 0) & (last != track) & (before >= 0)
    fragment = evaluated & (before != track) & (final | (last >= 0) & (after >= 0))

    counted = np.add.reduceat(counts[:, 0], start, dtype=np.int64)
    tracked = np.add.reduceat(matched & (counts | first), start, axis=0, dtype=np.int64)
    known = counted > 0
    share = tracked[known] / counted[known, None]
    never = ~np.logical_or.reduceat(matched, start, axis=0)[known]
    fragment &= np.repeat(known, length)[:, None]
    switch &= np.repeat(known, length)[:, None]
    total = max(1, int(known.sum()))
    return TrajectoryCounts(
        switch.sum(axis=0),
        fragment.sum(axis=0),
        ((share > 0.8) & ~never).sum(axis=0) / total,
        ((share < 0.2) | never).sum(axis=0) / total,
    )

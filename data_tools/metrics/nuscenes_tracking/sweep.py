"""CLEAR matching at many score thresholds at once.

In each frame and threshold, tracks below the threshold are absent, and (as in py-motmetrics, whose accumulator the
official evaluation uses)

1. an object, in order of the table, keeps the track it was matched to last, if that is within the gate;
2. the rest is assigned by the Hungarian method, as many pairs as possible first, then the least sum of distances;
   a pair whose object was last matched to another track is an identity switch.

Everything but time is vectorised: all scenes, classes and thresholds advance by one frame together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from data_tools.metrics.assignment import Candidates, optimal_pairs
from data_tools.metrics.nuscenes_tracking.scored_boxes import ScoredBoxes
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Rows:
    """`ScoredBoxes` of all scenes, in order of frame, then scene; identities are unique over all scenes."""

    scene: IntArray
    boxes: ScoredBoxes
    identities: int

    @classmethod
    def of(cls, scenes: Sequence[ScoredBoxes]) -> Rows:
        counts = [int(s.identity.max(initial=-1)) + 1 for s in scenes]
        offset = np.cumsum([0, *counts])
        joined = ScoredBoxes.concatenate(
            [replace(s, identity=s.identity + first) for s, first in zip(scenes, offset, strict=False)]
        )
        scene = np.repeat(np.arange(len(scenes)), [len(s.frame) for s in scenes])
        order = np.lexsort((scene, joined.frame))
        return cls(scene[order], joined.select(order), int(offset[-1]))


@dataclass(frozen=True, eq=False)
class RowPairs:
    """P pairs of a true row and a found row of the same scene, frame and class, in order of found, then true row."""

    true: IntArray
    found: IntArray
    distance: FloatArray


@dataclass(frozen=True, eq=False)
class Sweep:
    """The matching of N true rows at T thresholds.

    partner   (N, T) found row, -1 where missed
    switched  (N, T) identity switches
    distance  (classes, T) sum of the distances of all pairs, m
    """

    partner: IntArray
    switched: BoolArray
    distance: FloatArray


def candidate_pairs(true: Rows, found: Rows, gate: float) -> RowPairs:
    """All pairs of one class nearer than `gate` (m).

    Distances come from |a|^2 - 2 a.b + |b|^2, as in the official evaluation: far from the origin this leaves a few
    1e-5 m in a distance near zero, in the official figures as in these (there it also depends on the processor).
    """
    scenes = int(max(true.scene.max(initial=0), found.scene.max(initial=0))) + 1
    true_frame = true.boxes.frame * scenes + true.scene
    found_frame = found.boxes.frame * scenes + found.scene
    frames = np.intersect1d(true_frame, found_frame)
    t0, t1 = np.searchsorted(true_frame, frames), np.searchsorted(true_frame, frames, side="right")
    f0, f1 = np.searchsorted(found_frame, frames), np.searchsorted(found_frame, frames, side="right")
    parts = [(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty(0))]
    for a0, a1, b0, b1 in zip(t0.tolist(), t1.tolist(), f0.tolist(), f1.tolist(), strict=True):
        a, b = true.boxes.xy[a0:a1], found.boxes.xy[b0:b1]
        square = -2.0 * (a[:, None, 0] * b[None, :, 0] + a[:, None, 1] * b[None, :, 1])
        square += (a[:, 0] ** 2 + a[:, 1] ** 2)[:, None]
        square += (b[:, 0] ** 2 + b[:, 1] ** 2)[None, :]
        distance = np.sqrt(np.maximum(square, 0.0))
        near = (distance < gate) & (true.boxes.label[a0:a1, None] == found.boxes.label[None, b0:b1])
        column, row = np.nonzero(near.T)
        parts.append((row + a0, column + b0, distance[row, column]))
    return RowPairs(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def sweep(true: Rows, found: Rows, pairs: RowPairs, thresholds: FloatArray) -> Sweep:
    """Match at `thresholds` (classes, T) of the track score, NaN where a class has no further threshold."""
    classes, T = thresholds.shape
    partner = np.full((len(true.scene), T), -1, dtype=np.int64)
    switched = np.zeros((len(true.scene), T), dtype=np.bool_)
    total = np.zeros(classes * T)
    last = np.full((true.identities, T), -1, dtype=np.int64)
    label, identity = true.boxes.label, true.boxes.identity
    track, score = found.boxes.identity, found.boxes.score
    bounds = np.searchsorted(true.boxes.frame[pairs.true], np.arange(true.boxes.frame.max(initial=-1) + 2))
    for start, stop in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True):
        if start == stop:
            continue
        here = RowPairs(pairs.true[start:stop], pairs.found[start:stop], pairs.distance[start:stop])
        present = score[here.found][:, None] >= thresholds[label[here.true]]
        remembered = last[identity[here.true]]
        kept = _first_of_each(present & (remembered == track[here.found][:, None]), here.found)
        free = present & ~_used(kept, here.true) & ~_used(kept, here.found)
        group = true.scene[here.true] * classes + label[here.true]
        pair, at = np.nonzero(optimal_pairs(Candidates(here.true, here.found, here.distance, group), free))
        rows = here.true[pair]
        switched[rows, at] = remembered[pair, at] >= 0
        old_pair, old_at = np.nonzero(kept)
        pair, at = np.concatenate([pair, old_pair]), np.concatenate([at, old_at])
        rows = here.true[pair]
        partner[rows, at] = here.found[pair]
        last[identity[rows], at] = track[here.found[pair]]
        total += np.bincount(label[rows] * T + at, weights=here.distance[pair], minlength=classes * T)
    return Sweep(partner, switched, total.reshape(classes, T))


def _first_of_each(previous: BoolArray, found: IntArray) -> BoolArray:
    """The first previous pair (P, T) of each found row (P,); the rows are sorted."""
    start = np.flatnonzero(np.diff(found, prepend=-1))
    count = np.cumsum(previous, axis=0, dtype=np.int32)
    before = (count[start] - previous[start])[np.repeat(np.arange(len(start)), np.diff(start, append=len(found)))]
    return np.asarray(previous & (count - before == 1))


def _used(kept: BoolArray, row: IntArray) -> BoolArray:
    """(P, T): True if the pair's row is part of a kept pair."""
    first = int(row.min())
    used = np.zeros((int(row.max()) - first + 1, kept.shape[1]), dtype=np.bool_)
    pair, at = np.nonzero(kept)
    used[row[pair] - first, at] = True
    return np.asarray(used[row - first])

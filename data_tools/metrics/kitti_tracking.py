"""KITTI 3D multi-object tracking metrics, averaged over recall: sAMOTA, AMOTA, AMOTP and the rest.

True and found boxes of a class are matched frame by frame: as many pairs with the required 3D IoU as possible, and
among those the largest sum of IoU. Thresholds on the mean score of a track are set where the recall comes nearest to
1/40, 2/40, ...; with the counts at each (objects gt that count, misses FN, false alarms FP, switches IDS)

    MOTA   = 1 - (FN + FP + IDS) / gt
    sMOTA  = min(1, max(0, 1 - (FN + FP + IDS - (1 - r) gt) / (r gt)))         r: the target recall
    MOTP   = mean 3D IoU of the pairs
    sAMOTA, AMOTA, AMOTP: sums of sMOTA, MOTA, MOTP over the thresholds that are reached, divided by 40

and the CLEAR metrics at the threshold with the highest MOTA. Implemented from the paper, with results equal to its
authors' evaluation: thresholds are run from few tracks to many, after a run with all, and a found box that matched in
any of these runs is never exempt (`kitti_boxes`) in a later one.

The authors' evaluation averages a track's score anew before each run, so that rounding drops some tracks from the very
run whose threshold is their score (`track_scores`). One long track can change sAMOTA by many points this way.
With mean scores computed once, a track whose score equals the threshold is always present: `samota_safe`, `mota_safe`
and `threshold_safe` are sAMOTA, the highest MOTA and its threshold of such runs.

Source: Weng et al., 3D Multi-Object Tracking: A Baseline and New Evaluation Metrics, IROS 2020, section IV.

The mean score of each track, run after run, to the last bit.

The reference evaluation replaces the score of every box by the mean over its track, and does so again before each
further run. The mean of n equal numbers, added up one after the other, need not be that number in its last bit; and
since every threshold *is* the score of some track, that track then fails its own threshold or passes it. With few
tracks this changes the averages by whole points, so results are comparable only if the rounding is repeated.

Identity switches, fragments and coverage of true trajectories, counted as the KITTI benchmark counts them.

With g(f) the track matched in the object's f-th frame, -1 for none, and `last` the latest track of an earlier frame,
forgotten at frames in which the object does not count:

    switch    last != g(f), and last, g(f), g(f - 1) are all tracks
    fragment  g(f) != g(f - 1), and last, g(f), g(f + 1) are all tracks; in the last frame: g(f) != g(f - 1), a track

A trajectory that never counts is left out. Mostly tracked: in over 0.8 of the frames that count; mostly lost: in under
0.2 of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_tools.metrics.kitti_boxes import (
    ClassBoxes,
    KittiSimilarity,
    KittiTrackingSequence,
    found_boxes,
    joined_ranges,
    kitti_hota_metrics,
    true_boxes,
)
from data_tools.metrics.scene_boxes import Candidates, best_pairs, optimal_pairs
from saga_fg.numerics import BoolArray, FloatArray, IntArray
from saga_fg.types import paired_iou_3d

__all__ = [
    "KittiSimilarity",
    "KittiTrackingMetrics",
    "KittiTrackingSequence",
    "kitti_hota_metrics",
    "kitti_tracking_metrics",
]


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


RECALLS = 40


@dataclass(frozen=True)
class KittiTrackingMetrics:
    """Metrics of one class at one IoU: shares in [0, 1] (MOTA and AMOTA may be negative) and counts.

    gt: true boxes that count; mt, ml: shares of trajectories mostly tracked, mostly lost; tp, recall and precision
    include pairs with true boxes that don't count. samota, amota, amotp are averages, all others are at the `threshold`
    on a track's mean score that gives the best MOTA (-inf: all tracks). samota_safe, mota_safe, threshold_safe: without
    the rounding of the reference evaluation (see the module), those to compare results by.
    """

    samota: float
    samota_safe: float
    amota: float
    amotp: float
    mota: float
    motp: float
    recall: float
    precision: float
    mt: float
    ml: float
    gt: int
    tp: int
    fp: int
    fn: int
    ids: int
    frag: int
    threshold: float
    mota_safe: float
    threshold_safe: float


def kitti_tracking_metrics(
    sequences: Sequence[KittiTrackingSequence], label: str, min_iou: float
) -> KittiTrackingMetrics | None:
    """Metrics of class `label` ("car", "pedestrian", "cyclist") over all sequences; None if no true box counts.

    Pairs need a 3D IoU of at least `min_iou`; the benchmark uses 0.25, 0.5 and 0.7. Raises `InputError` for objects of
    the class without a 3D box.
    """
    true, found = (boxes(sequences, label.lower()) for boxes in (true_boxes, found_boxes))
    gt = int((~true.exempt).sum())
    if gt == 0:
        return None
    candidates = _candidates(true, found, min_iou)
    everything = best_pairs(candidates)
    mean = track_scores(found.score, found.identity, 1)[:, 0]
    thresholds, recalls = _thresholds(true, candidates, everything, mean)

    cuts = np.array([-np.inf, *thresholds])
    scores = track_scores(found.score, found.identity, len(cuts) + 1)
    unmatched = np.zeros(len(found), dtype=np.bool_)
    present, safely = scores[:, :-1] >= cuts, mean[:, None] >= cuts
    runs = _runs(true, found, candidates, present, unmatched)
    safe = runs if np.array_equal(present, safely) else _runs(true, found, candidates, safely, unmatched)
    best, best_safe = runs.best, safe.best
    final = _runs(true, found, candidates, scores[:, -1:] >= cuts[best], runs.matched)

    tp, fn, fp = int(final.tp[0]), int(final.fn[0]), int(final.fp[0])
    return KittiTrackingMetrics(
        samota=_samota(runs, recalls),
        samota_safe=_samota(safe, recalls),
        amota=float(runs.mota[1:].sum() / RECALLS),
        amotp=float(runs.motp[1:].sum() / RECALLS),
        mota=float(final.mota[0]),
        motp=float(final.motp[0]),
        recall=tp / (tp + fn) if tp else 0.0,
        precision=tp / (tp + fp) if tp else 0.0,
        mt=float(final.trajectories.mostly_tracked[0]),
        ml=float(final.trajectories.mostly_lost[0]),
        gt=gt,
        tp=tp,
        fp=fp,
        fn=fn,
        ids=int(final.trajectories.switches[0]),
        frag=int(final.trajectories.fragments[0]),
        threshold=float(cuts[best]),
        mota_safe=float(safe.mota[best_safe]),
        threshold_safe=float(cuts[best_safe]),
    )


@dataclass(frozen=True, eq=False)
class _Runs:
    """Counts of R runs, each with other tracks present.

    tp, fn, fp, trajectories, overlap (sum of the pairs' IoU)  (R,)
    matched  (M,) found boxes that matched in any run up to the last
    """

    gt: int
    tp: IntArray
    fn: IntArray
    fp: IntArray
    trajectories: TrajectoryCounts
    overlap: FloatArray
    matched: BoolArray

    @property
    def errors(self) -> IntArray:
        return np.asarray(self.fn + self.fp + self.trajectories.switches)

    @property
    def mota(self) -> FloatArray:
        return np.asarray(1.0 - self.errors / self.gt)

    @property
    def best(self) -> int:
        """The run with the highest MOTA; the first, with all tracks, if no threshold makes MOTA positive."""
        return int(np.argmax([0.0, *self.mota[1:]]))

    @property
    def motp(self) -> FloatArray:
        return np.asarray(self.overlap / np.maximum(self.tp, 1))


def _samota(runs: _Runs, recalls: FloatArray) -> float:
    """sAMOTA of a run with all tracks, followed by one for each target recall."""
    smota = 1.0 - (runs.errors[1:] - (1.0 - recalls) * runs.gt) / (recalls * runs.gt)
    return float(np.clip(smota, 0.0, 1.0).sum() / RECALLS)


def _candidates(true: ClassBoxes, found: ClassBoxes, min_iou: float) -> Candidates:
    """All pairs in the same frame with enough 3D IoU; cost 1 - IoU."""
    first = np.searchsorted(found.frame_key, true.frame_key)
    last = np.searchsorted(found.frame_key, true.frame_key, side="right")
    row, column = joined_ranges(first, last)
    a, b = true.boxes, found.boxes
    offset = a.position[row, :2] - b.position[column, :2]
    reach = (np.hypot(a.size[row, 0], a.size[row, 1]) + np.hypot(b.size[column, 0], b.size[column, 1])) / 2
    near = np.hypot(offset[:, 0], offset[:, 1]) < reach
    row, column = row[near], column[near]
    cost = 1.0 - paired_iou_3d(a.select(row), b.select(column))
    enough = cost <= 1.0 - min_iou
    row, column = row[enough], column[enough]
    return Candidates(row, column, cost[enough], true.frame_key[row])


def _thresholds(
    true: ClassBoxes, candidates: Candidates, chosen: BoolArray, score: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Score thresholds and the recalls they are for, from the pairs of the run with all tracks.

    The n-th of the matched scores, in descending order, is the threshold of recall n / to_find; it is taken if the next
    one is no nearer to the target recall. The first threshold is dropped, its target is recall 0.
    """
    found_at_all = np.zeros(len(true), dtype=np.bool_)
    found_at_all[candidates.row[chosen]] = True
    to_find = len(true) - int((true.exempt & ~found_at_all).sum())
    matched = np.sort(score[candidates.column[chosen]])[::-1].tolist()
    thresholds, recalls, target = [], [], 0.0
    for n, value in enumerate(matched):
        here, following = (n + 1) / to_find, (n + 2) / to_find
        if n + 1 < len(matched) and following - target < target - here:
            continue
        thresholds.append(value)
        recalls.append(target)
        target += 1 / RECALLS
    return np.array(thresholds[1:]), np.array(recalls[1:])


def _runs(
    true: ClassBoxes, found: ClassBoxes, candidates: Candidates, present: BoolArray, matched_before: BoolArray
) -> _Runs:
    """Match and count with the found boxes `present` (M, R) in each run; `matched_before` (M,) in earlier runs."""
    pairs = optimal_pairs(candidates, present[candidates.column])
    pair, run = np.nonzero(pairs)
    track = np.full((len(true), pairs.shape[1]), -1, dtype=np.int64)
    track[candidates.row[pair], run] = found.identity[candidates.column[pair]]
    matched = np.zeros_like(present)
    matched[candidates.column[pair], run] = True
    matched = np.logical_or.accumulate(matched, axis=1) | matched_before[:, None]
    tp = pairs.sum(axis=0)
    order = np.lexsort((true.frame_key, true.identity))
    return _Runs(
        gt=int((~true.exempt).sum()),
        tp=tp,
        fn=len(true) - tp - (true.exempt[:, None] & (track < 0)).sum(axis=0),
        fp=present.sum(axis=0) - tp - (present & found.exempt[:, None] & ~matched).sum(axis=0),
        trajectories=trajectory_counts(track[order], true.identity[order], true.exempt[order]),
        overlap=(1.0 - candidates.cost) @ pairs,
        matched=matched[:, -1],
    )

"""Whole tracks: which are true, which are ghosts beside a better one, and how well their scores rank them.

    true          more than half of the track's boxes match a labelled object (`nearest_pairs`)
    ghost         more than half of them overlap a better track of the class in the same frame, that is have a
                  bird's-eye IoU above `OVERLAP` with it; it may be another better track in every frame
    rank quality  average precision of the tracks in order of falling score: mean precision at the true ones

        AP = sum over thresholds k of (r_k - r_{k-1}) p_k,   p = true / tracks,   r = true / all true tracks

The score of a track is the mean of those of its boxes, by which AMOTA ranks too. A better track has a higher one; of
equal ones the track of more boxes is better. AP is 1 if every true track is above every false one, and the share of
true tracks if scores tell nothing. Every track counts once, however long it is.

Source of AP: Manning, Raghavan and Schuetze, Introduction to Information Retrieval, 2008, section 8.4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_tools.metrics.error_summary import OVERALL
from data_tools.metrics.label_errors import GATE
from data_tools.metrics.labels.precision_recall import ScoredPairs, precision_recall
from data_tools.metrics.nearest_pairs import near_pairs, nearest_pairs
from data_tools.metrics.scene_boxes import SceneBoxes
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, StrArray
from saga_fg.numerics.columns import Columns
from saga_fg.types.boxes import Boxes
from saga_fg.types.overlap import paired_bev_iou

OVERLAP = 0.1  # none of 965 labelled objects (nuScenes mini, KITTI) overlaps another one that much most of the time


@dataclass(frozen=True, eq=False)
class WholeTracks(Columns):
    """N tracks, each (N,). Boxes of one identity and different classes are different tracks.

    label   class
    score   mean score of the boxes
    true    True if more than half of the boxes match a labelled object
    ghost   True if more than half of them overlap a better track
    """

    label: StrArray
    score: FloatArray
    true: BoolArray
    ghost: BoolArray


@dataclass(frozen=True)
class TrackSummary:
    """Figures of one class: counts of tracks, the share of ghosts and the rank quality, NaN where undefined."""

    tracks: int
    true: int
    ghosts: int
    ghost_share: float
    rank_quality: float


def whole_tracks(truth: SceneBoxes, found: SceneBoxes, gate: float = GATE) -> WholeTracks:
    """The tracks `found` in one scene beside its labels; a box further than `gate` (m) from a label never matches."""
    kinds, label = np.unique(found.boxes.label, return_inverse=True)
    names, identity = np.unique(found.id, return_inverse=True)
    _, first, track = np.unique(label * len(names) + identity, return_index=True, return_inverse=True)
    count = np.bincount(track, minlength=len(first))
    start = found.score[first]  # the mean of equal scores is that score to the last bit
    score = start + np.bincount(track, found.score - start[track], len(first)) / count
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.lexsort((-count, -score))] = np.arange(len(first))
    _, matched, _ = nearest_pairs((truth.frame, truth.boxes), (found.frame, found.boxes), gate)

    def mostly(rows: IntArray) -> BoolArray:
        return np.asarray(2 * np.bincount(track[rows], minlength=len(first)) > count)

    return WholeTracks(
        kinds[label[first]], score, mostly(matched), mostly(_covered(found.frame, found.boxes, rank[track]))
    )


def track_summaries(tracks: WholeTracks) -> dict[str, TrackSummary]:
    """The figures of each class, preceded by those of all classes, which are one ranking."""
    classes = {
        OVERALL: tracks,
        **{label: tracks.select(tracks.label == label) for label in np.unique(tracks.label).tolist()},
    }
    return {label: _summary(each) for label, each in classes.items()}


def _summary(tracks: WholeTracks) -> TrackSummary:
    true, ghosts = int(tracks.true.sum()), int(tracks.ghost.sum())
    ranking = precision_recall([ScoredPairs(tracks.score, tracks.true, true)])
    return TrackSummary(
        len(tracks),
        true,
        ghosts,
        ghosts / len(tracks) if len(tracks) else float("nan"),
        ranking.average_precision if true else float("nan"),
    )


def _covered(frame: IntArray, boxes: Boxes, rank: IntArray) -> IntArray:
    """Rows of the boxes (n) over a box of smaller rank (n,), of the same frame (n,) and class."""
    diameter = np.hypot(boxes.size[:, 0], boxes.size[:, 1])
    covered = []
    for label in np.unique(boxes.label).tolist():  # near boxes of a class are no further apart than its largest box
        rows = np.flatnonzero((boxes.label == label) & np.isfinite(diameter + boxes.yaw))
        placed = frame[rows], boxes.select(rows)
        worse, better, apart = near_pairs(placed, placed, float(diameter[rows].max(initial=0.0)))
        worse, better = rows[worse], rows[better]
        touching = (rank[better] < rank[worse]) & (2 * apart < diameter[worse] + diameter[better])
        worse, better = worse[touching], better[touching]
        covered.append(worse[paired_bev_iou(boxes.select(worse), boxes.select(better)) > OVERLAP])
    return np.unique(np.concatenate([np.empty(0, dtype=np.int64), *covered]))

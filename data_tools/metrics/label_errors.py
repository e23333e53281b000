"""Errors of tracks at labelled objects, their summary, and the quality of whole tracks.

Labels and tracks are paired frame by frame (`nearest_pairs`). If the detections are given, errors of position, velocity
and heading are those at labels that a detection matches: every tracker with the same detections is then evaluated on
the same labels, and its position errors compare with those of the detections. Covariances are evaluated on all pairs.

The velocity of a label is the difference of its positions `reach` frames before and after,

    v_k = (p_{k+r} - p_{k-r}) / (t_{k+r} - t_{k-r})

and unknown where the object has no label at either. A label is *moving* if its speed is at least `MOVING`, else parked.

Summary of the errors at labels: root mean squares, and the consistency of the covariances.

The shares of errors within the tracks' ellipses (`data_tools.metrics.error_sample`) are meaningful for classes with
enough objects and boxes.

Whole tracks: which are true, which are ghosts beside a better one, and how well their scores rank them.

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

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from data_tools.metrics.error_sample import ErrorSample, coverages, nees
from data_tools.metrics.labels import ScoredPairs, precision_recall
from data_tools.metrics.scene_boxes import SceneBoxes, near_pairs, nearest_pairs
from saga_fg.numerics.arrays import BoolArray, Columns, FloatArray, IntArray, StrArray
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.types.boxes import Boxes, paired_bev_iou

GATE = 2.0  # m
MOVING = 1.0  # m/s


@dataclass(frozen=True, eq=False)
class LabelErrors(Columns):
    """N labels, each (N,); NaN where there is no track, no detection, or where a quantity is unknown.

    label      class
    object     number of the object, from 0
    speed      of the label, m/s
    matched    True where a detection matches it; True for all if no detections are given
    detection  error of that detection's position, m
    position, velocity, heading  errors of the track, m, m/s, rad in [0, pi]
    nees       normalised squared error of the track's position, 2 degrees of freedom
    """

    label: StrArray
    object: IntArray
    speed: FloatArray
    matched: BoolArray
    detection: FloatArray
    position: FloatArray
    velocity: FloatArray
    heading: FloatArray
    nees: FloatArray

    @classmethod
    def pool(cls, scenes: Iterable[Self]) -> Self:
        """The labels of all scenes; objects of different scenes get different numbers."""
        parts, first = [], 0
        for scene in scenes:
            parts.append(replace(scene, object=scene.object + first))
            first += int(scene.object.max(initial=-1)) + 1
        return cls.concatenate(parts)

    @property
    def tracked(self) -> BoolArray:
        """(N,) True for labels with a track."""
        return np.isfinite(self.position)

    @property
    def moving(self) -> BoolArray:
        """(N,) True for moving labels, False for unknown speed."""
        return np.asarray(self.speed >= MOVING)

    def sample(self, name: str, rows: BoolArray | None = None) -> ErrorSample:
        """The known errors `name` of matched labels with a track, limited to the mask `rows` (N,) if given."""
        chosen = self.matched & self.tracked
        return ErrorSample.known(getattr(self, name)[chosen if rows is None else chosen & rows])


def label_errors(
    truth: SceneBoxes,
    found: SceneBoxes,
    velocity: FloatArray,
    detections: tuple[IntArray, Boxes] | None = None,
    gate: float = GATE,
) -> LabelErrors:
    """The errors of `found` at the labels `truth` (N) of one scene, whose velocities (N, 2) are given.

    detections  (frame (M,), boxes (M)): the input of the tracker
    gate        largest distance of a label and its track or detection, m
    """
    n = len(truth)
    columns: dict[str, Any] = {
        name: np.full(n, np.nan) for name in ("detection", "position", "velocity", "heading", "nees")
    }
    placed = truth.frame, truth.boxes
    row, column, distance = nearest_pairs(placed, (found.frame, found.boxes), gate)
    a, b = truth.boxes.select(row), found.boxes.select(column)
    columns["position"][row] = distance
    columns["velocity"][row] = np.linalg.norm(b.velocity - velocity[row], axis=1)
    columns["heading"][row] = np.abs(wrap_angle(b.yaw - a.yaw))
    columns["nees"][row] = nees((b.position - a.position)[:, :2], found.position_covariance[column])
    matched = np.ones(n, dtype=np.bool_)
    if detections is not None:
        row, _, distance = nearest_pairs(placed, detections, gate)
        columns["detection"][row] = distance
        matched = np.isfinite(columns["detection"])
    _, number = np.unique(truth.id, return_inverse=True)
    return LabelErrors(truth.boxes.label, number, np.linalg.norm(velocity, axis=1), matched, **columns)


def label_velocities(truth: SceneBoxes, timestamps: FloatArray, reach: int) -> FloatArray:
    """Velocities (N, 2), m/s, of labels over `reach` frames to either side; NaN where these have no label.

    timestamps  (K,) of the frames, s
    """
    _, number = np.unique(truth.id, return_inverse=True)
    stride = len(timestamps) + 2 * reach
    key = number * stride + truth.frame + reach
    order = np.argsort(key)
    before, after = (_rows_of(key[order], key + step) for step in (-reach, reach))
    known = (before >= 0) & (after >= 0)
    first, last = order[before[known]], order[after[known]]
    velocity = np.full((len(truth), 2), np.nan)
    elapsed = timestamps[truth.frame[last]] - timestamps[truth.frame[first]]
    velocity[known] = (truth.boxes.position[last, :2] - truth.boxes.position[first, :2]) / elapsed[:, None]
    return velocity


def _rows_of(keys: IntArray, wanted: IntArray) -> IntArray:
    """Row of each wanted key among the sorted keys, -1 if missing."""
    at = np.minimum(np.searchsorted(keys, wanted), max(len(keys) - 1, 0))
    return np.where(keys[at] == wanted, at, -1) if len(keys) else np.empty(0, dtype=np.int64)


FEWEST_OBJECTS, FEWEST_BOXES = 20, 500
BANDS = {0.5: (0.4, 0.6), 0.9: (0.85, 0.95), 0.99: (0.96, 1.0)}
OVERALL = "overall"


@dataclass(frozen=True)
class ErrorSummary:
    """Figures of one class, NaN where undefined.

    labels, tracked      matched labels, and those of them with a track
    position, detection  RMSE of tracks and of detections on the same labels, m
    velocity, velocity_parked, velocity_moving   RMSE, m/s, of known velocities
    velocity_unknown     labels of known velocity whose track has none
    heading              RMSE, rad; flipped: share of headings off by more than 90 degrees
    """

    labels: int
    tracked: int
    position: float
    detection: float
    velocity: float
    velocity_parked: float
    velocity_moving: float
    velocity_unknown: int
    heading: float
    flipped: float


@dataclass(frozen=True)
class EllipseCoverage:
    """Consistency of the covariances of one class.

    objects, boxes  that have a track with a covariance
    anees           mean NEES over its 2 degrees of freedom: 1 if the covariances are right
    median_nees     over that of the chi-square distribution
    coverage        share of the errors within the ellipse, by its probability
    """

    objects: int
    boxes: int
    anees: float
    median_nees: float
    coverage: Mapping[float, float]

    @property
    def enough_data(self) -> bool:
        """True with enough objects and boxes for a conclusion."""
        return self.objects >= FEWEST_OBJECTS and self.boxes >= FEWEST_BOXES

    @property
    def consistent(self) -> bool:
        """True if each share is within its band."""
        return all(low <= self.coverage[p] <= high for p, (low, high) in BANDS.items())


def error_summary(errors: LabelErrors) -> ErrorSummary:
    """Summarise errors."""
    heading = errors.sample("heading").values
    moving = errors.moving
    tracked = errors.matched & errors.tracked
    return ErrorSummary(
        labels=int(errors.matched.sum()),
        tracked=int(tracked.sum()),
        position=errors.sample("position").rmse,
        detection=errors.sample("detection").rmse,
        velocity=errors.sample("velocity").rmse,
        velocity_parked=errors.sample("velocity", ~moving).rmse,
        velocity_moving=errors.sample("velocity", moving).rmse,
        velocity_unknown=int((tracked & np.isfinite(errors.speed) & np.isnan(errors.velocity)).sum()),
        heading=errors.sample("heading").rmse,
        flipped=float(np.mean(heading > np.pi / 2)) if len(heading) else float("nan"),
    )


def calibration(errors: LabelErrors) -> EllipseCoverage:
    """Compare errors with their covariances."""
    known = np.isfinite(errors.nees)
    values = errors.nees[known]
    return EllipseCoverage(
        objects=len(np.unique(errors.object[known])),
        boxes=len(values),
        anees=float(values.mean() / 2) if len(values) else float("nan"),
        median_nees=float(np.median(values) / (2 * np.log(2))) if len(values) else float("nan"),
        coverage=coverages(values, tuple(BANDS)),
    )


def errors_by_class(errors: LabelErrors) -> dict[str, LabelErrors]:
    """The errors of each class with labels, preceded by those of all classes."""
    labels = np.unique(errors.label).tolist()
    return {OVERALL: errors, **{label: errors.select(errors.label == label) for label in labels}}


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

"""The nuScenes tracking metrics, equal to the official evaluation: AMOTA, AMOTP and the rest.

The nuScenes tracking metrics: AMOTA, AMOTP and the metrics at the best threshold, per class and over all.

For each class, thresholds on the track score are chosen such that recall takes 40 values from 0.1 to 1, by
interpolating the scores of the matched boxes; a threshold shared by several recalls is evaluated once and counted
several times; a recall that is not reached counts with the worst value. Implemented from the definition of the task,
with results equal to the official evaluation (`nuscenes.eval.tracking`, configuration `tracking_nips_2019`).

Sources: https://www.nuscenes.org/tracking; Caesar et al., nuScenes, CVPR 2020; Weng et al., AB3DMOT, IROS 2020.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np

from data_tools.metrics.nuscenes_sweep import (
    NuScenesClassMetrics,
    RecallCurves,
    Rows,
    Sweep,
    candidate_pairs,
    scored_boxes,
    sweep,
    track_coverage,
)
from data_tools.metrics.scene_boxes import SceneBoxes
from saga_fg.numerics import FloatArray
from saga_fg.settings import setting, settings_group
from saga_fg.types import Boxes, Scene

_MIN_RECALL = 0.1  # lowest recall of the sweep
_RECALLS = 40  # values of recall in the sweep; this and the gate as in `tracking_nips_2019`
_GATE = 2.0  # m, from which a pair cannot match
_WORST_MOTP = 2.0  # MOTP of a recall that is not reached, m
_WORST_FAF = 500.0  # reported for a class that is never matched, false alarms per 100 frames
_WORST_DURATION = 20.0  # initialisation and gap duration of a class that is never matched, s
CLASS_RANGE = {
    "bicycle": 40.0,
    "bus": 50.0,
    "car": 50.0,
    "motorcycle": 40.0,
    "pedestrian": 40.0,
    "trailer": 50.0,
    "truck": 50.0,
}


@dataclass(frozen=True)
class NuScenesTrackingSettings:
    """Settings of the nuScenes tracking metrics; the defaults are the official ones."""

    class_range: Mapping[str, float] = settings_group(
        lambda: dict(CLASS_RANGE), "classes scored, and the distance from the vehicle up to which they are, m"
    )
    sample_period: float = setting(0.5, "time thin one frame counts in TID and LGD, s")


@dataclass(frozen=True, eq=False)
class NuScenesTrackingScene:
    """One scene to score, everything in world coordinates.

    timestamps    (K,) s, increasing
    ego_position  (K, 2) of the vehicle when its LiDAR fired, m
    truth         true boxes with at least one LiDAR or radar point
    found         the tracker's boxes
    racks         boxes of bicycle racks at each of the K frames; empty: there are none
    """

    timestamps: FloatArray
    ego_position: FloatArray
    truth: SceneBoxes
    found: SceneBoxes
    racks: Sequence[Boxes] = ()


@dataclass(frozen=True, eq=False)
class NuScenesTrackingMetrics:
    """Metrics over all classes and `per_class`, and the recall `curves` of classes with true boxes."""

    overall: NuScenesClassMetrics
    per_class: Mapping[str, NuScenesClassMetrics]
    curves: Mapping[str, RecallCurves]


def nuscenes_tracking_metrics(
    scenes: Sequence[NuScenesTrackingScene], settings: NuScenesTrackingSettings | None = None
) -> NuScenesTrackingMetrics:
    """Score the tracks of `scenes` together. Classes without true boxes have NaN metrics and no curves."""
    settings = settings or NuScenesTrackingSettings()
    class_range = dict(settings.class_range)
    true, found = (
        Rows.from_scenes(
            [
                scored_boxes(getattr(scene, name), scene.ego_position, scene.racks, scene.timestamps, class_range)
                for scene in scenes
            ]
        )
        for name in ("truth", "found")
    )
    pairs = candidate_pairs(true, found, _GATE)
    everything = sweep(true, found, pairs, np.full((len(class_range), 1), -np.inf))
    recalls = np.linspace(_MIN_RECALL, 1, _RECALLS).round(12)
    thresholds = np.stack(
        [_thresholds(true, found, everything, label, recalls) for label in range(len(class_range))]
    ).reshape(len(class_range), _RECALLS)
    matched = sweep(true, found, pairs, _without_repeats(thresholds))
    per_class, curves = {}, {}
    for label, name in enumerate(class_range):
        if (true.boxes.label == label).any():
            columns = _columns(true, found, matched, thresholds[label], label, settings)
            per_class[name] = _summary(columns)
            curves[name] = _curves(columns, recalls[::-1], thresholds[label])
        else:
            per_class[name] = NuScenesClassMetrics.undefined()
    return NuScenesTrackingMetrics(NuScenesClassMetrics.over_classes(per_class.values()), per_class, curves)


def _thresholds(true: Rows, found: Rows, everything: Sweep, label: int, recalls: FloatArray) -> FloatArray:
    """Score thresholds (T,) of a class for the recalls from high to low, NaN where a recall is not reached."""
    rows = true.boxes.label == label
    matches = rows & (everything.partner[:, 0] >= 0) & ~everything.switched[:, 0]
    scores = np.sort(found.boxes.score[everything.partner[matches, 0]])[::-1]
    if len(scores) == 0:
        return np.full(len(recalls), np.nan)
    reached = np.arange(1, len(scores) + 1) / int(rows.sum())
    thresholds = np.interp(recalls, reached, scores, right=0)
    thresholds[recalls > reached.max()] = np.nan
    return np.asarray(thresholds[::-1])


def _without_repeats(thresholds: FloatArray) -> FloatArray:
    """Thresholds (classes, T), in order, with NaN in place of repeated ones, where no box is present."""
    repeated = np.diff(thresholds, axis=1, prepend=np.nan) == 0
    return np.where(repeated, np.nan, thresholds)


def _columns(
    true: Rows, found: Rows, matched: Sweep, thresholds: FloatArray, label: int, settings: NuScenesTrackingSettings
) -> dict[str, FloatArray]:
    """The metrics of one class at each threshold (T,), NaN where the recall is not reached."""
    rows = np.flatnonzero(true.boxes.label == label)
    rows = rows[np.lexsort((true.boxes.frame[rows], true.boxes.identity[rows]))]
    partner, switched = matched.partner[rows], matched.switched[rows]
    tracked = partner >= 0
    detections, ids = tracked.sum(axis=0), switched.sum(axis=0)
    tp, fn = detections - ids, len(rows) - detections
    frames, present = _frames_and_boxes(true, found, thresholds, label)
    fp = present - detections
    gt = len(rows)
    recall = tp / gt
    with np.errstate(invalid="ignore", divide="ignore"):
        motar = np.maximum(0.0, 1.0 - ((fn + ids + fp) - (1.0 - recall) * gt) / (recall * gt))
        columns = {
            "recall": detections / gt,
            "motar": np.where(tp > 0, motar, np.nan),
            "gt": np.full(len(thresholds), gt),
            "mota": np.maximum(0.0, 1.0 - (fn + ids + fp) / gt),
            "motp": matched.distance[label] / detections,
            "faf": fp / frames * 100.0,
            "tp": tp,
            "fp": fp,
            "fn": fn,
            "ids": ids,
            **track_coverage(tracked, true.boxes.identity[rows], settings.sample_period),
        }
    if np.isnan(thresholds).all():
        worst = _never_matched(gt, len(np.unique(true.boxes.identity[rows])))
        return {name: np.full(len(thresholds), worst[name]) for name in columns}
    source = np.maximum.accumulate(
        np.where(np.diff(thresholds, prepend=np.nan) == 0, 0, np.arange(len(thresholds)))
    )  # the first column of each run of equal thresholds
    reached = ~np.isnan(thresholds)
    return {name: np.where(reached, column[source], np.nan) for name, column in columns.items()}


def _frames_and_boxes(true: Rows, found: Rows, thresholds: FloatArray, label: int) -> tuple[FloatArray, FloatArray]:
    """At each threshold (T,): frames with a true or found box of the class, and found boxes."""
    scenes = int(max(true.scene.max(initial=0), found.scene.max(initial=0))) + 1
    frame_of = [rows.boxes.frame * scenes + rows.scene for rows in (true, found)]
    with_truth = np.unique(frame_of[0][true.boxes.label == label])
    rows = np.flatnonzero(found.boxes.label == label)
    present = found.boxes.score[rows][:, None] >= thresholds
    elsewhere = ~np.isin(frame_of[1][rows], with_truth)
    frames = np.full(len(thresholds), float(len(with_truth)))
    if elsewhere.any():
        start = np.flatnonzero(np.diff(frame_of[1][rows][elsewhere], prepend=-1))
        frames += np.logical_or.reduceat(present[elsewhere], start, axis=0).sum(axis=0)
    return frames, present.sum(axis=0).astype(np.float64)


def _never_matched(gt: int, objects: int) -> dict[str, float]:
    """The metrics of a class of which no box is ever matched."""
    unknown = dict.fromkeys(("fp", "ids", "frag"), float("nan"))
    nothing = dict.fromkeys(("recall", "motar", "mota", "mt", "tp"), 0.0)
    duration = dict.fromkeys(("tid", "lgd"), _WORST_DURATION)
    totals = {"gt": float(gt), "fn": float(gt), "ml": float(objects)}
    return {**unknown, **nothing, **duration, **totals, "motp": _WORST_MOTP, "faf": _WORST_FAF}


def _summary(columns: Mapping[str, FloatArray]) -> NuScenesClassMetrics:
    """The metrics at the first threshold with the highest MOTA, and the means over the sweep."""
    best = int(np.nanargmax(columns["mota"]))
    return NuScenesClassMetrics(
        amota=float(np.mean(np.nan_to_num(columns["motar"], nan=0.0))),
        amotp=float(np.mean(np.nan_to_num(columns["motp"], nan=_WORST_MOTP))),
        **{name: float(column[best]) for name, column in columns.items()},
    )


def _curves(columns: Mapping[str, FloatArray], recalls: FloatArray, thresholds: FloatArray) -> RecallCurves:
    shown = {field.name: columns[field.name] for field in fields(RecallCurves) if field.name in columns}
    return RecallCurves(hypothetical_recall=recalls.copy(), score=thresholds, **shown)


def score_sweep(pairs: Sequence[tuple[Scene, SceneBoxes]]) -> NuScenesTrackingMetrics:
    """Score the tracks of scenes with ground truth by the metrics of the task: all classes, at any distance.

    Hidden objects are left out. A frame counts as one median step of time in TID and LGD.
    """
    scenes = []
    for scene, found in pairs:
        truth = SceneBoxes.of_annotations(scene.ground_truth or (), hidden=False)
        scenes.append(NuScenesTrackingScene(scene.timestamps, np.zeros((len(scene), 2)), truth, found))
    labels = sorted({label for each in scenes for t in (each.truth, each.found) for label in t.boxes.label.tolist()})
    steps = np.concatenate([np.empty(0), *(np.diff(each.timestamps) for each in scenes)])
    period = float(np.median(steps)) if len(steps) else 1.0
    settings = NuScenesTrackingSettings(class_range=dict.fromkeys(labels, np.inf), sample_period=period)
    return nuscenes_tracking_metrics(scenes, settings)


def best_thresholds(metrics: NuScenesTrackingMetrics) -> dict[str, float]:
    """The score threshold of best MOTA of each class that occurs; infinite for one that is never matched."""
    best = {}
    for label, curves in metrics.curves.items():
        reached = np.where(np.isfinite(curves.score), curves.mota, -np.inf)
        best[label] = float(curves.score[np.argmax(reached)]) if np.isfinite(curves.score).any() else np.inf
    return best

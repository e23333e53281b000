"""Figures of a nuScenes result class by class: ranks, ghosts by kind, objects of two classes, and oracles.

left out      least and largest AMOTA with one scene left out
rank          probability that a box of an object scores higher than one of none; one half: scores say nothing
ghosts        boxes of no object from the score of the best MOTA on, by the first of these that is so:
              beside        within the gate of an object of their class, which another box has
              other class   within the gate of an object of another class
              coasting      without a detection of their class within the gate
              clutter       all others
two classes   a frame with two boxes of different classes whose bird's-eye IoU is above `TWICE`, both from the
              score of the best MOTA of their classes on; of labelled boxes, one pair in a thousand overlaps so much
matching      an oracle: only the tracks that come within the gate of a labelled object of their class at some time
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from data_tools.datasets.nuscenes.source import in_range
from data_tools.metrics import (
    NuScenesTrackingScene,
    PlacedBoxes,
    SceneBoxes,
    best_thresholds,
    nuscenes_tracking_metrics,
)
from data_tools.metrics.scene_boxes import near_pairs, nearest_pairs
from saga_fg.numerics import BoolArray, FloatArray, StrArray
from saga_fg.types import paired_bev_iou, touching_pairs

TWICE = 0.2
LOW_SCORE = 0.1  # hidden objects at places that are hardly known have less
GATE = 2.0  # m, that of the official evaluation
OBJECT = "object"
GHOSTS = ("beside", "other class", "coasting", "clutter")


def class_rows(
    scenes: Sequence[NuScenesTrackingScene], detections: Sequence[PlacedBoxes]
) -> Iterator[Mapping[str, Any]]:
    """A row of figures for each class with labels, and their mean and label-weighted mean; detections: by scene."""
    found = nuscenes_tracking_metrics(scenes)
    matching = nuscenes_tracking_metrics([replace(s, found=s.found.select(_matching(s))) for s in scenes])
    others = [nuscenes_tracking_metrics([s for s in scenes if s is not out]) for out in scenes if len(scenes) > 1]
    thresholds = best_thresholds(found)
    rows: list[dict[str, Any]] = []
    for label, one in found.per_class.items():
        if one.gt > 0:
            judged = [_judged(*pair, label) for pair in zip(scenes, detections, strict=True)]
            score, kind = (np.concatenate(columns) for columns in zip(*judged, strict=True))
            left_out = [each.per_class[label].amota for each in others if each.per_class[label].gt > 0]
            means = {"AMOTA": one.amota, "AMOTA, matching tracks": matching.per_class[label].amota, "MOTA": one.mota}
            means["rank"] = rank_quality(score[kind == OBJECT], score[kind != OBJECT])
            sums = {"labels": one.gt, "false": one.fp, "missed": one.fn, "IDS": one.ids}
            sums |= {name: int(((kind == name) & (score >= thresholds[label])).sum()) for name in GHOSTS}
            rows.append({"class": label, **means, "left out": _span(left_out), **sums})
    yield from rows
    labels = np.array([row["labels"] for row in rows])
    twice = [frames_with_two_classes(each.found, thresholds) for each in scenes]
    share = float(np.average(twice, weights=[len(each.timestamps) for each in scenes]))
    for name, weight in (("mean", np.ones(len(rows))), ("by labels", labels)):
        means = {key: float(np.average([row[key] for row in rows], weights=weight)) for key in list(rows[0])[1:5]}
        left_out = [each.overall.amota for each in others] if name == "mean" else []
        sums = {key: sum(row[key] for row in rows) for key in list(rows[0])[6:]}
        yield {"class": name, **means, "left out": _span(left_out), **sums, "frames with two classes": share}


def _span(values: Sequence[float]) -> str:
    return f"{min(values):.3f} to {max(values):.3f}" if values else "-"


def rank_quality(true: FloatArray, false: FloatArray) -> float:
    """The probability that the score of a true box (n,) is above that of a false one (m,), ties counted half; NaN
    where there are none of either (Mann and Whitney 1947)."""
    if not len(true) or not len(false):
        return float("nan")
    ordered = np.sort(false)
    below, up_to = np.searchsorted(ordered, true, "left"), np.searchsorted(ordered, true, "right")
    return float((below + up_to).mean() / (2 * len(false)))


def _judged(scene: NuScenesTrackingScene, detections: PlacedBoxes, label: str) -> tuple[FloatArray, StrArray]:
    """Scores (n,) of the boxes of a class, and whether each is of an object, or what kind of ghost."""
    true, found = in_range(scene)
    found = found.select(np.flatnonzero(found.boxes.label == label))
    mine, kind = (found.frame, found.boxes), np.full(len(found.frame), "clutter", dtype="<U12")
    truth = (true.frame, true.boxes)
    detected = np.isin(np.arange(len(kind)), near_pairs(mine, detections, GATE)[0])
    any_class = (true.frame, replace(true.boxes, label=np.full(len(true.frame), label)))
    kind[~detected] = "coasting"
    kind[near_pairs(mine, any_class, GATE)[0]] = "other class"
    kind[near_pairs(mine, truth, GATE)[0]] = "beside"
    kind[nearest_pairs(mine, truth, GATE)[0]] = OBJECT
    return found.score, kind


def _matching(scene: NuScenesTrackingScene) -> BoolArray:
    """(N,) which boxes are of tracks that some labelled object of their class is ever near."""
    found = scene.found
    near, _, _ = near_pairs((found.frame, found.boxes), (scene.truth.frame, scene.truth.boxes), GATE)
    return np.isin(found.id, found.id[near])


def frames_with_two_classes(result: SceneBoxes, thresholds: Mapping[str, float] | None = None) -> float:
    """Share of the frames with boxes in which a place is reported as two classes.

    thresholds  least score by class, `LOW_SCORE` where it is not known
    """
    scores = [(thresholds or {}).get(label, LOW_SCORE) for label in result.boxes.label.tolist()]
    shown, frames = result.score >= np.array(scores), np.unique(result.frame)
    twice = 0
    for frame in frames:
        boxes = result.boxes.select(np.flatnonzero((result.frame == frame) & shown))
        a, b = touching_pairs(boxes, boxes)
        other = boxes.label[a] < boxes.label[b]
        twice += bool((paired_bev_iou(boxes.select(a[other]), boxes.select(b[other])) > TWICE).any())
    return twice / max(len(frames), 1)

"""Figures of a nuScenes result class by class, objects that are reported as two classes, and tracks that match nothing.

two classes   a frame with two boxes of different classes whose bird's-eye IoU is above `TWICE`, both from the
              score of the best MOTA of their classes on; of labelled boxes, one pair in a thousand overlaps so much
matching      an oracle: only the tracks that come within the gate of a labelled object of their class at some time
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from data_tools.evaluation import best_thresholds
from data_tools.metrics import NuScenesTrackingScene, SceneBoxes, nuscenes_tracking_metrics
from saga_fg.numerics.arrays import BoolArray
from saga_fg.types.boxes import paired_bev_iou, touching_pairs

TWICE = 0.2
LOW_SCORE = 0.1  # hidden objects at places that are hardly known have less
GATE = 2.0  # m, that of the official evaluation


def class_rows(scenes: Sequence[NuScenesTrackingScene]) -> Iterator[Mapping[str, Any]]:
    """A row of figures for each class with labels, and their mean and label-weighted mean."""
    found = nuscenes_tracking_metrics(scenes)
    matching = nuscenes_tracking_metrics([replace(s, found=s.found.select(_matching(s))) for s in scenes])
    rows: list[dict[str, Any]] = []
    for label, one in found.per_class.items():
        if one.gt > 0:
            oracle = matching.per_class[label].amota
            figures = {"AMOTA": one.amota, "AMOTA, matching tracks": oracle, "MOTA": one.mota}
            rows.append(
                {"class": label, "labels": one.gt, **figures, "false": one.fp, "missed": one.fn, "IDS": one.ids}
            )
    yield from rows
    labels = np.array([row["labels"] for row in rows])
    twice = [frames_with_two_classes(each.found, best_thresholds(found)) for each in scenes]
    share = float(np.average(twice, weights=[len(each.timestamps) for each in scenes]))
    for name, weight in (("mean", np.ones(len(rows))), ("by labels", labels)):
        means = {key: float(np.average([row[key] for row in rows], weights=weight)) for key in list(rows[0])[2:5]}
        sums = {key: sum(row[key] for row in rows) for key in ("labels", "false", "missed", "IDS")}
        yield {"class": name, **means, **sums, "frames with two classes": share}


def _matching(scene: NuScenesTrackingScene) -> BoolArray:
    """(N,) which boxes are of tracks that some labelled object of their class is ever near."""
    true, found, near = scene.truth, scene.found, np.zeros(len(scene.found.frame), dtype=bool)
    for frame in np.unique(found.frame):
        a, b = np.flatnonzero(found.frame == frame), np.flatnonzero(true.frame == frame)
        apart = found.boxes.position[a, None, :2] - true.boxes.position[b, :2]
        possible = (np.hypot(apart[..., 0], apart[..., 1]) < GATE) & (found.boxes.label[a, None] == true.boxes.label[b])
        near[a] = possible.any(axis=1)
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

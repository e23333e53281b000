"""Precision and recall of boxes within a matching distance.

A box is a true positive if it is matched to a visible object within the distance: in order of their scores, boxes take
the nearest free object of their frame and class (the matching of the nuScenes detection benchmark,
https://www.nuscenes.org/object-detection, "Matching"). Boxes matched to hidden objects are ignored. Over a threshold on
the score,

    precision = true / (true + false),   recall = true / visible objects
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from data_tools.metrics.nearest_pairs import near_pairs
from data_tools.metrics.scene_boxes import SceneBoxes
from saga_fg.numerics.arrays import BoolArray, FloatArray


class ScoredPairs(NamedTuple):
    """Boxes of a system that count: score (B,), true (B,) for true positives, and the number of visible objects."""

    score: FloatArray
    true: BoolArray
    objects: int


@dataclass(frozen=True, eq=False)
class PrecisionRecall:
    """Precision (B,) and recall (B,) for falling score thresholds."""

    precision: FloatArray
    recall: FloatArray

    @property
    def whole(self) -> tuple[float, float]:
        """Precision and recall of all boxes."""
        return (float(self.precision[-1]), float(self.recall[-1])) if len(self.recall) else (float("nan"), 0.0)

    @property
    def best(self) -> tuple[float, float]:
        """Precision and recall where F1, their harmonic mean, is best."""
        if len(self.recall) == 0:
            return float("nan"), 0.0
        f1 = 2 * self.precision * self.recall / np.maximum(self.precision + self.recall, 1e-12)
        k = int(np.argmax(f1))
        return float(self.precision[k]), float(self.recall[k])

    @property
    def average_precision(self) -> float:
        """Area under the curve, a step function: precision weighted by the gain in recall."""
        return float(np.sum(np.diff(self.recall, prepend=0.0) * self.precision))

    def recall_at(self, precision: float) -> float:
        """The largest recall with at least this precision; 0 if there is none."""
        return float(self.recall[self.precision >= precision].max(initial=0.0))


def scored_pairs(truth: SceneBoxes, visible: BoolArray, found: SceneBoxes, distance: float) -> ScoredPairs:
    """Match the boxes of one scene within `distance`, m; visible (N,) of the true boxes."""
    i, j, apart = near_pairs((truth.frame, truth.boxes), (found.frame, found.boxes), distance)
    order = np.lexsort((apart, j, -found.score[j]))  # by falling score, then by distance
    taken = np.zeros(len(truth), dtype=np.bool_)
    true = np.zeros(len(found), dtype=np.bool_)
    counts = np.ones(len(found), dtype=np.bool_)
    last = -1
    for row, column in zip(i[order].tolist(), j[order].tolist(), strict=True):
        if column == last or taken[row]:
            continue
        taken[row], last = True, column
        true[column] = counts[column] = visible[row]
    return ScoredPairs(found.score[counts], true[counts], int(visible.sum()))


def precision_recall(scenes: list[ScoredPairs]) -> PrecisionRecall:
    """The curve of all scenes together."""
    score = np.concatenate([np.empty(0), *(scene.score for scene in scenes)])
    true = np.concatenate([np.empty(0, dtype=np.bool_), *(scene.true for scene in scenes)])
    objects = sum(scene.objects for scene in scenes)
    order = np.argsort(-score, kind="stable")
    hits = np.cumsum(true[order])
    last = np.flatnonzero(np.diff(score[order], append=-np.inf) < 0)  # boxes of equal score share one threshold
    return PrecisionRecall(hits[last] / (last + 1), hits[last] / max(objects, 1))

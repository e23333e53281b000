r"""Precision and recall of boxes at a distance, and the recall of several systems at one precision.

A box is true if it is matched to a visible object within the distance: boxes of the same moment and class choose in
order of their scores, each the nearest object that is free (the matching of the nuScenes detection benchmark,
https://www.nuscenes.org/object-detection, "Matching"). Boxes at hidden objects count neither way. Over a threshold on
the score,

    precision = true / (true + false),   recall = true / visible objects
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from data_tools.metrics.scene_boxes import SceneBoxes
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray


class ScoredPairs(NamedTuple):
    """The boxes of a system that count: score (B,), whether each is true (B,), and how many objects there were."""

    score: FloatArray
    true: BoolArray
    objects: int


@dataclass(frozen=True, eq=False)
class PrecisionRecall:
    """The curve from the highest score down: precision (B,) and recall (B,)."""

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

    def recall_at(self, precision: float) -> float:
        """The largest recall with at least this precision, 0 if it is never reached."""
        return float(self.recall[self.precision >= precision].max(initial=0.0))


def scored_pairs(truth: SceneBoxes, visible: BoolArray, found: SceneBoxes, distance: float) -> ScoredPairs:
    """Match the boxes of one scene within `distance`, m; visible (N,) of the true boxes."""
    object_, box = _candidates(truth, found, distance)
    taken = np.zeros(len(truth), dtype=np.bool_)
    true = np.zeros(len(found), dtype=np.bool_)
    counts = np.ones(len(found), dtype=np.bool_)
    last = -1
    for i, j in zip(object_.tolist(), box.tolist(), strict=True):  # in order of score, then of distance
        if j == last or taken[i]:
            continue
        taken[i], true[j], counts[j], last = True, visible[i], visible[i], j
    return ScoredPairs(found.score[counts], true[counts], int(visible.sum()))


def precision_recall(scenes: list[ScoredPairs]) -> PrecisionRecall:
    """The curve of all scenes together."""
    score = np.concatenate([np.empty(0), *(scene.score for scene in scenes)])
    true = np.concatenate([np.empty(0, dtype=np.bool_), *(scene.true for scene in scenes)])
    objects = sum(scene.objects for scene in scenes)
    order = np.argsort(-score, kind="stable")
    hits = np.cumsum(true[order])
    last = np.flatnonzero(np.diff(score[order], append=-np.inf) < 0)  # boxes of equal score come together
    return PrecisionRecall(hits[last] / (last + 1), hits[last] / max(objects, 1))


def _candidates(truth: SceneBoxes, found: SceneBoxes, distance: float) -> tuple[IntArray, IntArray]:
    """Rows of objects and boxes of one moment and class within the distance, by falling score, then by distance."""
    if len(truth) == 0 or len(found) == 0:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    labels = np.unique(np.concatenate([truth.boxes.label, found.boxes.label]))
    origin = truth.boxes.position[0, :2]
    a, b = (
        np.column_stack(
            [
                table.boxes.position[:, :2] - origin,
                3.0 * distance * (table.moment * len(labels) + np.searchsorted(labels, table.boxes.label)),
            ]
        )
        for table in (truth, found)
    )
    near = cKDTree(a).sparse_distance_matrix(cKDTree(b), distance, output_type="ndarray")
    order = np.lexsort((near["v"], near["j"], -found.score[near["j"]]))
    return near["i"][order], near["j"][order]

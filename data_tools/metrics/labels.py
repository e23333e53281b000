"""Quality of labels: precision and recall, and errors on common boxes.

Errors of several systems on common true boxes: those that every system matches.

Pairs are the nearest within a gate, frame by frame and class by class (`nearest_pairs`): first with the visible
objects, then, of the remaining boxes, with the hidden ones. A pair counts if its track is paired with no other object
more often: where one system has no box any more, the nearest one is that of a neighbour. A system that finds more boxes
also finds more difficult ones, so systems are compared on the boxes that all of them find.

Precision and recall of boxes within a matching distance.

A box is a true positive if it is matched to a visible object within the distance: in order of their scores, boxes take
the nearest free object of their frame and class (the matching of the nuScenes detection benchmark,
https://www.nuscenes.org/object-detection, "Matching"). Boxes matched to hidden objects are ignored. Over a threshold on
the score,

    precision = true / (true + false),   recall = true / visible objects
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from data_tools.metrics.label_errors import ErrorSample, nees
from data_tools.metrics.scene_boxes import SceneBoxes, near_pairs, nearest_pairs
from saga_fg.numerics import BoolArray, Columns, FloatArray, IntArray, StrArray, wrap_angle

__all__ = [
    "QUANTITIES",
    "CommonBoxes",
    "LabelledScene",
    "PrecisionRecall",
    "common_boxes",
    "precision_recall",
    "scored_pairs",
]

QUANTITIES = ("position", "heading", "size", "velocity", "nees")


@dataclass(frozen=True, eq=False)
class LabelledScene:
    """One scene: N true boxes, and the boxes of several systems.

    truth     all objects, hidden ones too
    visible   (N,) True for objects that a sensor could see
    velocity  (N, 2) m/s, NaN where unknown
    distance  (N,) from the vehicle, m
    systems   boxes by name of the system
    """

    truth: SceneBoxes
    visible: BoolArray
    velocity: FloatArray
    distance: FloatArray
    systems: Mapping[str, SceneBoxes]


@dataclass(frozen=True, eq=False)
class CommonBoxes(Columns):
    """M true boxes that every one of S systems matches.

    label (M,), distance (M,) m, visible (M,)
    errors   (M, S, Q) of `QUANTITIES`: position m, heading rad, size m (mean of length, width, height), velocity m/s,
             nees (squared position error over its covariance, 2 degrees of freedom); NaN where unknown
    systems  names of the S systems
    """

    label: StrArray
    distance: FloatArray
    visible: BoolArray
    errors: FloatArray
    systems: tuple[str, ...]

    def sample(self, system: str, quantity: str) -> ErrorSample:
        """The known errors of a system."""
        return ErrorSample.known(self.errors[:, self.systems.index(system), QUANTITIES.index(quantity)])


def common_boxes(scene: LabelledScene, gate: float) -> CommonBoxes:
    """The true boxes that every system matches within `gate` (m), with the errors of each system."""
    errors = np.stack([_errors(scene, table, gate) for table in scene.systems.values()], axis=1)
    found = np.asarray(np.isfinite(errors[:, :, 0]).all(axis=1))
    whole = CommonBoxes(scene.truth.boxes.label, scene.distance, scene.visible, errors, tuple(scene.systems))
    return whole.select(found)


def visible_then_hidden(
    truth: SceneBoxes, visible: BoolArray, found: SceneBoxes, gate: float
) -> tuple[IntArray, IntArray]:
    """Rows of matched true and found boxes: visible objects are matched first, then hidden ones."""
    free = np.arange(len(found))
    pairs = []
    for rows in (np.flatnonzero(visible), np.flatnonzero(~visible)):
        a, b = truth.select(rows), found.select(free)
        i, j, _ = nearest_pairs((a.frame, a.boxes), (b.frame, b.boxes), gate)
        pairs.append((rows[i], free[j]))
        free = np.setdiff1d(free, free[j])
    return np.concatenate([p[0] for p in pairs]), np.concatenate([p[1] for p in pairs])


def _errors(scene: LabelledScene, found: SceneBoxes, gate: float) -> FloatArray:
    """(N, Q) the errors of one system at all true boxes, NaN where it has none."""
    row, column = visible_then_hidden(scene.truth, scene.visible, found, gate)
    own = _holds_most(scene.truth.id[row], found.id[column])
    row, column = row[own], column[own]
    a, b = scene.truth.boxes.select(row), found.boxes.select(column)
    offset = (b.position - a.position)[:, :2]
    errors = np.full((len(scene.truth), len(QUANTITIES)), np.nan)
    errors[row, 0] = np.hypot(*offset.T)
    errors[row, 1] = np.abs(wrap_angle(b.yaw - a.yaw))
    errors[row, 2] = np.abs(b.size - a.size).mean(axis=1)
    errors[row, 3] = np.hypot(*(b.velocity - scene.velocity[row]).T)
    errors[row, 4] = nees(offset, found.position_covariance[column])
    return errors


def _holds_most(objects: StrArray, tracks: StrArray) -> BoolArray:
    """(P,) of pairs whose track is paired with no other object more often."""
    track, of_track = np.unique(tracks, return_inverse=True)
    pair, of_pair, count = np.unique(
        np.stack([of_track, np.unique(objects, return_inverse=True)[1]]),
        axis=1,
        return_inverse=True,
        return_counts=True,
    )
    most = np.zeros(len(track), dtype=np.int64)
    np.maximum.at(most, pair[0], count)
    return np.asarray(count[of_pair.ravel()] == most[of_track])


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

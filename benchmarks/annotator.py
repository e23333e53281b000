"""Errors of labels against the truth, and an annotator who knows the truth and corrects the tracks looked at.

Labels are handed out where P(exists) >= `KEPT`. Their errors, track by track:

    false    a track of which less than half of the boxes is within `GATE` of a true object of any class: once
    class    a track more than half of whose boxes are at true objects of other classes: once
    join     a change from one true object to another, between boxes that match
    off      a box of a true track that is off by `FAR_OFF` or `TURNED_OFF`, from the true one that it matches
    missed   a visible true box, detected within `GATE`, that no label matches
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from data_tools.evaluation import placed_detections
from data_tools.metrics import SceneBoxes
from data_tools.metrics.scene_boxes import nearest_pairs
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.smoothing import Labels, Probabilities
from saga_fg.types.dataset import Scene

KEPT = 0.5
GATE = 2.0  # m
FAR_OFF, TURNED_OFF = 0.5, np.pi / 9  # m and rad


@dataclass(frozen=True, eq=False)
class JudgedLabels:
    """N labels of a scene against its truth.

    found    the labels; truth: the true boxes of classes that are detected
    own      (N,) row of the true box that a label matches, -1 for none; any: of whatever class is near
    off      (N,) whether it is far off it; turned: by more than 90 degrees; kept (N,) whether it is handed out
    missed   (M,) which true boxes are missed
    """

    found: SceneBoxes
    truth: SceneBoxes
    own: IntArray
    any: IntArray
    off: BoolArray
    turned: BoolArray
    kept: BoolArray
    missed: BoolArray

    def tracks(self) -> dict[str, IntArray]:
        """The rows of each track, in order of time."""
        order = np.argsort(self.found.id, kind="stable")
        names, starts = np.unique(self.found.id[order], return_index=True)
        return dict(zip(names.tolist(), np.split(order, starts[1:]), strict=True))

    def is_false(self, rows: IntArray) -> bool:
        """Whether these are the labels of no true object."""
        return bool((self.any[rows] >= 0).mean() < 0.5)

    def is_other_class(self, rows: IntArray) -> bool:
        """Whether these are the labels of an object of another class."""
        return not self.is_false(rows) and bool((self.own[rows] >= 0).mean() < 0.5)

    def joins(self, rows: IntArray) -> list[tuple[int, int]]:
        """Pairs of successive rows between which a track changes from one true object to another."""
        rows = rows[self.own[rows] >= 0]
        name = self.truth.id[self.own[rows]]
        changed = name[:-1] != name[1:]
        return [(int(a), int(b)) for a, b in zip(rows[:-1][changed], rows[1:][changed], strict=True)]

    def errors(self) -> dict[str, int]:
        """Numbers of errors by kind."""
        counts = dict.fromkeys(("false", "class", "join", "off", "missed"), 0)
        for rows in self.tracks().values():
            if not self.kept[rows[0]]:
                continue
            if self.is_false(rows):
                counts["false"] += 1
            else:
                counts["class"] += self.is_other_class(rows)
                counts["join"] += len(self.joins(rows))
                counts["off"] += int(self.off[rows].sum())
        counts["missed"] = int(self.missed.sum())
        return counts


def judged(scene: Scene, labels: Sequence[Labels]) -> JudgedLabels:
    """Compare labels with the truth of their scene."""
    assert scene.ground_truth is not None
    found = SceneBoxes.of_tracks([moment.tracks for moment in labels])
    frame, boxes = placed_detections(scene)
    classes = np.unique(np.concatenate([boxes.label, found.boxes.label]))
    truth = SceneBoxes.of_annotations(scene.ground_truth)
    visible = np.concatenate([moment.visible for moment in scene.ground_truth])
    kept = np.concatenate([np.empty(0), *(moment.probability.exists for moment in labels)]) >= KEPT
    own, any_ = np.full(len(found), -1), np.full(len(found), -1)
    row, column, distance = nearest_pairs((truth.frame, truth.boxes), (found.frame, found.boxes), GATE)
    own[column] = row
    off, turned = np.zeros((2, len(found)), dtype=np.bool_)
    angle = np.abs(wrap_angle(truth.boxes.yaw[row] - found.boxes.yaw[column]))
    off[column] = visible[row] & ((distance > FAR_OFF) | (angle > TURNED_OFF))
    turned[column] = angle > np.pi / 2
    alike = [(table.frame, replace(table.boxes, label=np.full(len(table), "any"))) for table in (truth, found)]
    row, column, _ = nearest_pairs(alike[0], alike[1], GATE)
    any_[column] = row
    other = own >= 0
    any_[other] = own[other]
    seen = np.zeros(len(truth), dtype=np.bool_)
    seen[nearest_pairs((truth.frame, truth.boxes), (frame, boxes), GATE)[0]] = True
    matched = np.zeros(len(truth), dtype=np.bool_)
    handed = found.select(np.flatnonzero(kept))
    matched[nearest_pairs((truth.frame, truth.boxes), (handed.frame, handed.boxes), GATE)[0]] = True
    missed = visible & seen & ~matched & np.isin(truth.boxes.label, classes)
    return JudgedLabels(found, truth, own, any_, off, turned, kept, missed)


BINS = (0.0, 0.1, 0.5, 0.9, 1.0)


class Answers:
    """What labels say of objects, and what is so: by question rows of both and a weight."""

    def __init__(self) -> None:
        self.said: dict[str, list[tuple[float, float, float]]] = {}

    def add(self, scene: JudgedLabels, labels: Sequence[Labels]) -> None:
        """Ask whether the objects of a scene exist, and of those that do whether class, identity and heading are
        right; headings count by boxes."""
        p = Probabilities.concatenate([moment.probability for moment in labels])

        def answer(question: str, said: FloatArray, right: float, weight: float = 1.0) -> None:
            self.said.setdefault(question, []).append((float(said[rows[0]]), float(right), float(weight)))

        for rows in scene.tracks().values():
            own = scene.own[rows] >= 0
            answer("exists", p.exists, own.mean() > 0.5)
            if not scene.is_false(rows):
                answer("class", p.label, own.mean() > 0.5)
            if own.mean() > 0.5:
                answer("identity", p.one, not scene.joins(rows))
                answer("heading", p.heading, 1 - scene.turned[rows][own].mean(), own.sum())

    def rows(self) -> Iterator[dict[str, Any]]:
        """A row for each question and range of what was said."""
        for question, answers in self.said.items():
            said, true, weight = np.array(answers).reshape(-1, 3).T
            for low, high in pairwise(BINS):
                mine = (said >= low) & ((said < high) | (high == 1.0))
                if mine.any():
                    figures = (float(np.average(column[mine], weights=weight[mine])) for column in (said, true))
                    yield {"question": question, "from": low, "to": high, "objects": int(mine.sum())} | dict(
                        zip(("said", "is"), figures, strict=True)
                    )

r"""Class of an object: a discrete belief of its track over the classes that detectors mistake for each other.

    L_j(c)    = A_s(z_j | c)                              likelihood of class c by detection j of the class z_j
    cost_ij  += -2 log sum_c b_i(c) L_j(c)                in association, within the group
    b_i(c)   <- b_i(c) L_j(c) / sum                       in the update, when j is matched to i

A_s(z | c) is the chance that sensor s reports an object of class c as a z. False detections are counted by class, so
that this is the ratio of likelihoods of `saga_fg.tracking.association` again. A track's class is the likeliest, the
present one if several are; its score counts by the belief in that class. Beliefs are kept away from 0 and 1: a detector
that errs in one frame errs in the next as well. Between groups, and outside of all, nothing is matched, and a track
keeps its first class.

Source: Bar-Shalom, Kirubarajan, Gokberk, Tracking with Classification-Aided Multiframe Data Association, IEEE
Transactions on Aerospace and Electronic Systems 41(3), 2005.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from saga_fg.model.sensor import Sensor
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, StrArray, distinct

LEAST_BELIEF = 1e-3  # in each class of the group


class ClassGroups:
    """C classes in groups of those that are mistaken for each other; beliefs and likelihoods are (..., C), 0 outside
    of the group."""

    def __init__(self, groups: Sequence[Sequence[str]]) -> None:
        self._groups = tuple(tuple(group) for group in groups)
        self.classes = tuple(label for group in self._groups for label in group)
        self._number = [number for number, group in enumerate(self._groups) for _ in group]
        self._column = {label: k for k, label in enumerate(self.classes)}
        self._of_label: dict[str, int] = {}  # numbers as `numbers` gives them

    def __len__(self) -> int:
        return len(self.classes)

    def same_group(self, labels: StrArray, others: StrArray) -> BoolArray:
        """(n, m) which classes (n,) equal others (m,) or share a group with them."""
        return np.asarray(self.numbers(labels)[:, None] == self.numbers(others))

    def numbers(self, label: StrArray) -> IntArray:
        """(n,) equal for classes that equal each other or share a group, also between calls."""
        classes, of_row = distinct(label)
        return np.array([self._of_label.get(c) or self._numbered(c) for c in classes], dtype=np.int64)[of_row]

    def _numbered(self, label: str) -> int:
        column = self._column.get(label)
        first = label if column is None else self._groups[self._number[column]][0]
        return self._of_label.setdefault(label, self._of_label.setdefault(first, len(self._of_label) + 1))

    def pairs_of_group(self, labels: StrArray, others: StrArray, i: IntArray, j: IntArray) -> BoolArray:
        """(K,) whether the classes of labels[i] and others[j], i and j (K,), are one or share a group."""
        return np.asarray(self.numbers(labels)[i] == self.numbers(others)[j])

    def likelihood(self, label: StrArray, sensor: Sensor) -> FloatArray:
        """L (m, C) of detections of the classes `label` (m,) by a sensor."""
        if not self.classes:
            return np.empty((len(label), 0))
        row, of_group = self._rows(label)
        return np.asarray(self._confusion(sensor)[row] * of_group[:, None])

    def updated(self, belief: FloatArray, likelihood: FloatArray) -> FloatArray:
        """Beliefs (k, C) after a detection of likelihood (k, C) each; by that alone where there is no belief yet."""
        if not self.classes:
            return belief
        of_group = likelihood > 0
        before = np.where(belief.sum(axis=1, keepdims=True) > 0, belief, of_group)
        after = before * likelihood
        after = after / np.maximum(after.sum(axis=1, keepdims=True), 1e-300)
        after = np.where(of_group, np.maximum(after, LEAST_BELIEF), 0.0)
        return np.asarray(after / np.maximum(after.sum(axis=1, keepdims=True), 1e-300))

    def labels(self, belief: FloatArray, label: StrArray) -> StrArray:
        """The likeliest classes (n,) by beliefs (n, C), of tracks that had the classes `label` (n,)."""
        row, of_group = self._rows(label)
        had = np.where(of_group, belief[np.arange(len(label)), row], np.inf)
        best = belief.argmax(axis=1)
        likelier = belief.max(axis=1, initial=0.0) > had + 1e-9
        if not likelier.any():
            return label
        return np.where(likelier, np.array(self.classes)[best], label)

    def certainty(self, belief: FloatArray) -> FloatArray:
        """(n,) largest belief of (n, C); 1 outside of all groups."""
        most = belief.max(axis=1, initial=0.0)
        return np.where(most > 0, most, 1.0)

    def _rows(self, label: StrArray) -> tuple[IntArray, BoolArray]:
        """Columns (n,) of labels (n,), 0 for those outside of all groups, and which are inside of one (n,)."""
        occurring, index = distinct(label)
        column = np.array([self._column.get(c, -1) for c in occurring], dtype=np.int64)[index]
        return np.maximum(column, 0), column >= 0

    def _confusion(self, sensor: Sensor) -> FloatArray:
        """A (C, C): by reported class, the chance of it for each true class of its group, 0 for others."""
        A = np.zeros((len(self), len(self)))
        for group in self._groups:
            rows = [self._column[label] for label in group]
            A[np.ix_(rows, rows)] = sensor.confusion_among(group).T
        return A


@dataclass(frozen=True, eq=False)
class ClassEvidence:
    """Evidence of a frame: belief (n, C) of the tracks, likelihood (m, C) of the detections."""

    groups: ClassGroups
    belief: FloatArray
    likelihood: FloatArray

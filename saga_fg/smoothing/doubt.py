"""Doubt about labels: probabilities that they are right, and what to expect of a person's look at an object.

Every label answers four questions with a probability: that the object exists, that it is of this class, that it is one
object all along, and that its heading is not turned round. A fifth one, that the box is far off (`FAR_OFF`,
`TURNED_OFF`), says where to look. Each is a logistic model of a few features,

    P = 1 / (1 + exp(-(b_0 + b . features)))

fitted to recordings with ground truth (four scenes of nuScenes, five of KITTI; `python -m benchmarks labels` has their
reliability), but that of one object all along, the product over its steps from a detection to the next. What
is bad with those detectors need not be so with others: what an object's own detections settle is not far off.

A look mends everything that is wrong with an object. Of n boxes handed out, where P(exists) is `HANDED_OUT` at least,
and of an object that is held back, the number of errors to go is expected to be

    gain = 1 - P(exists) + P(exists) ( 1 - P(class) + 1 - P(one) + n (1 - P(heading)) + sum_k P(box k is far off) )
    gain = n P(exists) P(class)

A false object is one error, and so are a wrong class and a wrong join; every box that is missing or off is one.
Boxes without a heading are not turned round.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from saga_fg.numerics import BoolArray, Columns, FloatArray, IntArray, StrArray, near_pairs
from saga_fg.smoothing.association import Evidence
from saga_fg.smoothing.states import Lifespans, Probabilities, StateTable
from saga_fg.types import ShownTable, data_frame

HANDED_OUT = 0.5  # P(exists)
LEAST_GAIN = 0.05  # of an object that is worth a look
FAR_OFF = 0.5  # of a position, m
TURNED_OFF = np.pi / 9  # of a heading up to half a turn, rad
RIVAL = 1.0  # distance within which a box of another class is at the same place, m; or a third of the length
REACH = 10.0  # within which objects may be mistaken for each other, m
COMPANION = 0.5  # sum of the probabilities of its detections from which an object counts there

EXISTS = (0.791, 1.589, 0.416)  # logit of the score, log of the number of detections
CLASS = (1.135, -2.327, 0.797, 0.489)  # share of the boxes with a rival of another class, then as EXISTS
HEADING = (0.662, 0.392, 1.006, 0.867)  # m moved (10 at most), votes (5 at most), votes per detection
OFF = (-1.048, 1.95, 1.061, -0.709)  # log deviation, m; log length, m; logit of the score
AXIS = (0.192, 0.666, -1.784, -1.499)  # log deviation, rad; log length, m; speed, m/s (3 at most)
LINK = (-3.981, 0.591, -0.763, 0.293)  # log gap, s; log distance of the nearest companion, m; log of the jump, m


def _probability(weights: tuple[float, ...], *features: FloatArray) -> FloatArray:
    z = weights[0] + sum(w * feature for w, feature in zip(weights[1:], features, strict=True))
    return np.asarray(1 / (1 + np.exp(-np.clip(z, -50.0, 50.0))))


def _logit(score: FloatArray) -> FloatArray:
    p = np.clip(score, 1e-4, 1 - 1e-4)
    return np.asarray(np.log(p / (1 - p)))


def step_doubt(
    evidence: Evidence, object_of: IntArray, lifespans: Lifespans, states: StateTable, length: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return (R,) log P that the detections before a state and at it are of one object, 0 where there are none; and
    (R,) whether an object of another class with more evidence is at its place.

    object_of (N,): the object of each detection, negative for none; length (n,) of the objects, m, NaN for unknown
    """
    rows = np.flatnonzero(object_of >= 0)
    rows = rows[np.lexsort((evidence.moment[rows], object_of[rows]))]
    weight = np.zeros(len(lifespans))
    np.add.at(weight, lifespans.rows_of(object_of[rows]), evidence.probability[rows])
    owner = lifespans.rows_of(states.id)
    nearest, rival = _companions(states, lifespans.label[owner], length[owner], weight[owner])
    later = rows[1:][object_of[rows[1:]] == object_of[rows[:-1]]]
    before = rows[:-1][object_of[rows[1:]] == object_of[rows[:-1]]]
    at, start = (states.rows_of(evidence.moment[mine], object_of[mine]) for mine in (later, before))
    gap = evidence.times[evidence.moment[later]] - evidence.times[evidence.moment[before]]
    moved = evidence.boxes.position[later, :2] - evidence.boxes.position[before, :2]
    jump = np.hypot(*(moved - states.mean[start, 2:] * gap[:, None]).T)
    features = np.maximum(gap, 1e-2), np.clip(nearest[at], 0.3, REACH), np.clip(jump, 0.1, REACH)
    wrong = _probability(LINK, *map(np.log, features))
    told = (evidence.corrected[later] > 0) | (evidence.corrected[before] > 0)
    return np.bincount(at, np.where(told, 0.0, np.log1p(-wrong)), len(states)).astype(np.float64), rival


def _companions(
    states: StateTable, label: StrArray, length: FloatArray, weight: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """(R,) distance of the nearest object of the class with some evidence, m, at most `REACH`; (R,) whether one of
    another class and more evidence is at the same place."""
    nearest, rival = np.full(len(states), REACH), np.zeros(len(states), dtype=np.bool_)
    place = np.maximum(RIVAL, np.nan_to_num(length) / 3)
    for k in np.unique(states.moment).tolist():
        here = states.at(k)
        position = states.mean[here, :2]
        a, b = near_pairs(position, position, np.full(len(position), REACH))
        a, b = a[a != b] + here.start, b[a != b] + here.start
        distance, same = np.hypot(*(states.mean[a, :2] - states.mean[b, :2]).T), label[a] == label[b]
        there = same & (weight[b] >= COMPANION)
        np.minimum.at(nearest, a[there], distance[there])
        rival[a[~same & (weight[b] > weight[a]) & (distance < place[a])]] = True
    return nearest, rival


def far_off(
    covariance: FloatArray,
    yaw_variance: FloatArray,
    speed: FloatArray,
    length: FloatArray,
    score: FloatArray,
    agreement: FloatArray,
) -> FloatArray:
    """(N,) probability that boxes are far off; covariance (N, 2, 2) of their positions, m^2, variance (N,) of their
    headings, rad^2, NaN without a heading, speed (N,) in m/s, length (N,) in m, NaN where unknown, score (N,),
    agreement (N,): mean cosine between an object's heading and the detected ones.

    What the features say is bounded by the tail of a normal error of twice the deviation, exp(-limit^2 / (8 variance)):
    of the position, and of the heading together with the spread of the detected ones, -2 log agreement.
    """
    size = np.log(np.maximum(np.nan_to_num(length, nan=1.0), 0.1))
    variance = np.maximum(np.trace(covariance, axis1=1, axis2=2) / 2, 1e-6)
    turning = np.maximum(yaw_variance, 1e-6)
    far = _probability(OFF, np.log(variance) / 2, size, _logit(score))
    turned = _probability(AXIS, np.log(turning) / 2, size, np.minimum(np.nan_to_num(speed), 3.0))
    spread = turning - 2 * np.log(np.clip(agreement, 1e-3, 1.0))
    far = np.minimum(far, np.exp(-(FAR_OFF**2) / (8 * variance)))
    turned = np.nan_to_num(np.minimum(turned, np.exp(-(TURNED_OFF**2) / (8 * spread))))
    return np.asarray(1 - (1 - far) * (1 - turned))


def object_probabilities(
    score: FloatArray,
    detections: FloatArray,
    weight: FloatArray,
    rivals: FloatArray,
    path: FloatArray,
    votes: FloatArray,
    one: FloatArray,
) -> Probabilities:
    """Return what is probably right of n objects by their score, the number of detections, the sum `weight` of their
    probabilities, the share of the boxes with a rival, the metres moved along the heading, the votes of detections for
    it, and P(one object all along): each (n,)."""
    found = _logit(score), np.log(np.maximum(detections, 1.0))
    votes = np.abs(votes)
    moved = np.minimum(np.abs(path), 10.0), np.minimum(votes, 5.0), votes / np.maximum(weight, 1e-9)
    exists, label = _probability(EXISTS, *found), _probability(CLASS, rivals, *found)
    return Probabilities(exists, label, one, _probability(HEADING, *moved))


@dataclass(frozen=True, eq=False)
class Review(Columns, ShownTable):
    """Objects, those first that are most worth a look: each (n,).

    id, label, boxes  name, class and number of boxes
    gain              expected number of errors that a look mends
    why               the largest part of it, of `REASONS`
    time, position    where to look, s and m (n, 2)
    probability       that the object exists, ...; far_off: expected number of boxes that are far off
    """

    id: IntArray
    label: StrArray
    boxes: IntArray
    gain: FloatArray
    why: StrArray
    time: FloatArray
    position: FloatArray
    probability: Probabilities
    far_off: FloatArray

    def table_columns(self) -> dict[str, Any]:
        """The columns (n,) of a table, by name."""
        gain, far_off, place = (np.round(values, 3) for values in (self.gain, self.far_off, self.position))
        shown = {"gain": gain, "why": self.why, "id": self.id, "label": self.label, "boxes": self.boxes}
        where = {"timestamp": self.time, "x": place[:, 0], "y": place[:, 1]}
        return {**shown, **where, **self.probability.table_columns(), "boxes_far_off": far_off}

    def to_pandas(self) -> Any:
        """Return a `pandas.DataFrame` of `table_columns`. Needs the extra `pandas`."""
        return data_frame(self.table_columns())

    def _shown(self) -> tuple[str, Mapping[str, Any]]:
        return f"{len(self)} objects", self.table_columns()


REASONS = np.array(["false", "missing", "class", "identity", "heading", "box"])


def gain_parts(probability: Probabilities, boxes: IntArray, headed: IntArray, off: FloatArray) -> FloatArray:
    """(n, 6) errors that a look at an object mends, by `REASONS`; boxes (n,), of which `headed` (n,) have a heading and
    `off` (n,) are far off."""
    p = probability
    wrong = [1 - p.label, 1 - p.one, headed * (1 - p.heading), off]
    parts = np.stack([1 - p.exists, 0 * p.exists, *(p.exists * part for part in wrong)], axis=-1)
    held_back = p.exists < HANDED_OUT
    parts[held_back] = 0.0
    parts[held_back, 1] = (boxes * p.exists * p.label)[held_back]
    return parts

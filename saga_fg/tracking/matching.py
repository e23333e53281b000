r"""Which detection of a frame belongs to which track, class by class.

    cost_ij      = d_ij^2 + log det S_ij - w GIoU_ij
    unmatched_ij = a 2 log( p_D r_i / (1 - p_D r_i) ) + b 2 log( p_j / (1 - p_j) ) - 2 log( 2 pi lambda )
    lambda       = sum over j of (1 - p_j) / clutter_area

A pair is matched for less than what it costs to leave both alone: with w = 0 and a = b = 1 the difference of the two is
-2 log of the ratio of likelihoods that the detection is the track's, or that the track was missed and the detection is
false. r_i is the track's existence, p_D the sensor's detection probability, p_j the detection's probability; a and b
below 1 say that they are no more than indications. lambda is how many false detections of the class there are per m^2:
as many as the frame's own scores admit, so that it fits any detector. A track that nobody believes in can't take a
strong detection from afar, least of all among many weak ones, and of two detections the stronger one is preferred.

The assignment is the one of least total cost (`hungarian`), is made cheapest pair first (`greedy`), or registers the
graph observed to the graph predicted (`graph`): to the costs above come those of `saga_fg.pairwise_costs` between the
pairs, of all classes, whose tracks the filter knows to be displaced alike.

Source: Blackman and Popoli, Design and Analysis of Modern Tracking Systems, 1999, section 6.2; Rezatofighi et al.,
Generalized Intersection over Union, CVPR 2019.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from saga_fg.arrays import BoolArray, FloatArray, IntArray, distinct
from saga_fg.association import Matching, assign, assign_greedily, gate, mahalanobis
from saga_fg.boxes import Boxes
from saga_fg.by_class import class_settings
from saga_fg.overlap import giou_3d
from saga_fg.pairwise_costs import CrossCovariances, pair_costs
from saga_fg.quadratic_matching import QuadraticMatching
from saga_fg.tracking.observation import Observed
from saga_fg.tracking.settings import AssociationSettings, ClassSettings, TrackerSettings

LEAST_CLUTTER = 0.05  # false detections to be reckoned with, however sure the detector is


class _ClassCosts(NamedTuple):
    """Of one class: rows of its tracks (n,) and detections (m,), and for each pair (n, m) the squared distance, the
    cost less that of leaving both alone, and whether it is inside the gate."""

    track: IntArray
    detection: IntArray
    d2: FloatArray
    gain: FloatArray
    possible: BoolArray


def associate(
    predicted: Boxes,
    P: FloatArray,
    expected: FloatArray,
    observed: Observed,
    settings: TrackerSettings,
    clutter_area: float,
    cross: CrossCovariances | None = None,
) -> Matching:
    """The pairs of a frame.

    predicted  where the n tracks were when the frame was taken, world
    P          (n, 2, 2) covariance of their positions
    expected   (n,) chance that the track is detected: its existence times that of an object to be detected
    clutter_area  of the module, m^2, of the sensor that speaks
    cross      covariances of the positions of tracks with each other, which the method `graph` needs
    """
    costs = list(_costs(predicted, P, expected, observed, settings, clutter_area))
    if not costs:
        return Matching.empty()
    if settings.association.method == "graph" and cross is not None:
        return _registered(costs, predicted, P, observed, cross, settings.association.pair_weight)
    match = assign_greedily if settings.association.method == "greedy" else assign
    pairs = []
    for each in costs:
        row, column = match(each.gain, each.possible, 0.0)
        pairs.append(Matching(each.track[row], each.detection[column], each.d2[row, column]))
    return Matching.concatenate(pairs)


def _costs(
    predicted: Boxes,
    P: FloatArray,
    expected: FloatArray,
    observed: Observed,
    settings: TrackerSettings,
    clutter_area: float,
) -> Iterator[_ClassCosts]:
    """Class by class, of those that are both predicted and observed."""
    (classes, of_track), (seen, of_detection) = distinct(predicted.label), distinct(observed.boxes.label)
    for label in classes:
        if label not in seen:
            continue
        t, d = np.flatnonzero(of_track == classes.index(label)), np.flatnonzero(of_detection == seen.index(label))
        of_class = class_settings(settings.classes, ClassSettings, label)
        position, measured = predicted.position[t, :2], observed.boxes.position[d, :2]
        d2, log_det = mahalanobis(position, P[t], measured, observed.R[d, :2, :2])
        apart = np.hypot(*np.moveaxis(measured[None] - position[:, None], -1, 0))
        possible = (d2 < gate(of_class.gate)) & (apart < of_class.max_distance)
        cost = d2 + log_det
        if of_class.overlap_weight > 0:
            overlap = giou_3d(predicted.select(t), observed.boxes.select(d), of_class.max_distance)
            cost = cost - of_class.overlap_weight * overlap
        unmatched = _unmatched(expected[t], observed.probability[d], settings.association, clutter_area)
        if unmatched is None:
            unmatched = cost.max(initial=0.0) + 1.0
        yield _ClassCosts(t, d, d2, cost - unmatched, possible)


def _registered(
    costs: list[_ClassCosts],
    predicted: Boxes,
    P: FloatArray,
    observed: Observed,
    cross: CrossCovariances,
    weight: float,
) -> Matching:
    """The matching of all classes together of least unary and pairwise cost."""
    at = [np.nonzero(each.possible) for each in costs]
    track, detection, d2, gain = (
        np.concatenate(parts)
        for parts in zip(
            *(
                (each.track[row], each.detection[column], each.d2[row, column], each.gain[row, column])
                for each, (row, column) in zip(costs, at, strict=True)
            ),
            strict=True,
        )
    )
    innovation = observed.boxes.position[detection, :2] - predicted.position[track, :2]
    S = P[track] + observed.R[detection, :2, :2]
    pairs = pair_costs(track, detection, innovation, S, cross)
    pairs = pairs._replace(cost=weight * pairs.cost)
    chosen = QuadraticMatching(track, detection, gain, pairs).solve()
    return Matching(track[chosen], detection[chosen], d2[chosen])


def _unmatched(
    expected: FloatArray, probability: FloatArray, settings: AssociationSettings, clutter_area: float
) -> FloatArray | None:
    """(n, m) of the module; None where clutter is spread over an infinite area."""
    if clutter_area == math.inf:
        return None
    density = max(float((1 - probability).sum()), LEAST_CLUTTER) / clutter_area
    of_track = settings.existence_weight * _log_odds(expected)
    of_detection = settings.score_weight * _log_odds(probability)
    return 2 * (of_track[:, None] + of_detection - math.log(2 * math.pi * density))


def _log_odds(probability: FloatArray) -> FloatArray:
    p = np.clip(probability, 1e-6, 1 - 1e-6)
    return np.log(p / (1 - p))

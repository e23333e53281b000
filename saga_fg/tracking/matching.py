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

Source: Blackman and Popoli, Design and Analysis of Modern Tracking Systems, 1999, section 6.2; Rezatofighi et al.,
Generalized Intersection over Union, CVPR 2019.
"""

from __future__ import annotations

import math

import numpy as np

from saga_fg.arrays import FloatArray, distinct
from saga_fg.association import Matching, assign, assign_greedily, gate, mahalanobis
from saga_fg.boxes import Boxes
from saga_fg.overlap import giou_3d
from saga_fg.tracking.observation import Observed
from saga_fg.tracking.settings import AssociationSettings, TrackerSettings, settings_of

LEAST_CLUTTER = 0.05  # false detections to be reckoned with, however sure the detector is


def associate(
    predicted: Boxes,
    P: FloatArray,
    expected: FloatArray,
    observed: Observed,
    settings: TrackerSettings,
    clutter_area: float,
) -> Matching:
    """The pairs of a frame.

    predicted  where the n tracks were when the frame was taken, world
    P          (n, 2, 2) covariance of their positions
    expected   (n,) chance that the track is detected: its existence times that of an object to be detected
    clutter_area  of the module, m^2, of the sensor that speaks
    """
    pairs = [Matching.empty()]
    (classes, of_track), (seen, of_detection) = distinct(predicted.label), distinct(observed.boxes.label)
    for label in classes:
        if label not in seen:
            continue
        t, d = np.flatnonzero(of_track == classes.index(label)), np.flatnonzero(of_detection == seen.index(label))
        of_class = settings_of(settings.classes, label)
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
        match = assign if settings.association.method == "hungarian" else assign_greedily
        row, column = match(cost, possible, unmatched)
        pairs.append(Matching(t[row], d[column], d2[row, column]))
    return Matching.concatenate(pairs)


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

r"""Report: the tracks of sufficient existence that are detected, or whose place is known well enough.

Each has a score and a calibrated covariance:

    score       max(p, g m) ( hits / (opportunities + prior_opportunities) )^w     while coasting times r
    P_reported  = ( c (1 + h (1 - p)) )^2 P + ( b (1 + k (1 - p)) )^2 u u^T

The score rests on all evidence of the track so far: p is the probability of its latest detection, m that of its best
one, g the share of it that lasts, r the existence. It is monotone in the evidence: a higher probability of any
detection lowers no score of the track, then or later, and neither does one more hit. A weak detection leaves the share
g, and a gap multiplies the scores of the boxes in it by r, which misses of a well-seen track hardly lower.

A filter's noise is wider than its errors where it also has to let the right detections through the gate, which are not
as Gaussian as it assumes: the factor c, of sensor and class, corrects this, and h its dependence on the probability p
of the latest detection. A detector that sees one side of a car misjudges its length, and with it the position of its
centre along the heading u, in one frame as in the next. No filter averages that away: the position bias b. Both are for
the report; the filter and the association, which compare detections with detections, do without them. c, b and their
growth are the sensor's noise settings, see `saga_fg.model.sensor`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.tracking.settings import ExistenceSettings
from saga_fg.tracking.track_table import TrackTable
from saga_fg.tracking.tracker_state import TrackerState
from saga_fg.types.track import Tracks

LASTING_SHARE = 0.3  # of the best detection's probability, which later boxes score at least; 0.2 to 0.5 rank alike


def report_tracks(state: TrackerState, timestamp: float) -> Tracks:
    """The tracks to be reported, as of `timestamp` (s)."""
    table, settings, rows = state.table, state.settings, reported_rows(state)
    coasting, tentative = table.coasting(state.time), table.tentative
    table, coasting, now = table.select(rows), coasting[rows], state.reported_kinematics().select(rows)
    boxes = replace(table.boxes(now.position + state.origin, now.velocity))  # checked, and their own
    P = calibrated_covariance(now.P, boxes.yaw, table.covariance_scale, table.position_bias)
    certainty = state.class_groups.certainty(table.class_belief)
    score = reported_score(table, certainty, coasting > 0, settings.existence)
    score = np.where(tentative[rows], settings.tentative_score_factor * score, score)
    return Tracks(timestamp, table.id, boxes, score, P, now.P_velocity, coasting)


def reported_rows(state: TrackerState) -> IntArray:
    """Rows of the tracks to be reported."""
    table, settings = state.table, state.settings
    coasting = table.coasting(state.time)
    carried = (coasting <= settings.report_coasting) & known_places(state)
    return np.flatnonzero(
        (~table.tentative | (settings.tentative_score_factor > 0))
        & (table.confirmed | (table.existence >= settings.existence.report_above))
        & ((coasting == 0) | carried)
        & (table.out_of_view(state.relative(state.clock.newest)) <= settings.max_out_of_view)
    )


def known_places(state: TrackerState) -> BoolArray:
    """(n,) tracks whose places, should they move, are known to the `max_deviation` of their class."""
    (most,) = state.class_values(state.table.label, "max_deviation")
    return np.asarray(state.kinematics().deviation <= most)


def reported_score(
    table: TrackTable, certainty: FloatArray, coasting: BoolArray, settings: ExistenceSettings
) -> FloatArray:
    """(n,) score of the tracks' boxes, times the certainty (n,) of the class; coasting (n,): not detected now."""
    hit_ratio = (table.hits / (table.opportunities + settings.prior_opportunities)) ** settings.hit_ratio_weight
    evidence = np.maximum(table.score, LASTING_SHARE * table.best_score)
    return np.asarray(evidence * certainty * hit_ratio * np.where(coasting, table.existence, 1.0))


def calibrated_covariance(P: FloatArray, yaw: FloatArray, scale: FloatArray, bias: FloatArray) -> FloatArray:
    """Reported covariances (n, 2, 2), m^2, of positions.

    P (n, 2, 2), yaw (n,), scale (n,) on the deviations, bias (n,) its deviation, m. Where the heading is unknown,
    half of the variance of the bias goes to each axis.
    """
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    direction = np.where(np.isfinite(yaw)[:, None, None], ahead[:, :, None] * ahead[:, None], np.eye(2) / 2)
    return np.asarray(scale[:, None, None] ** 2 * P + bias[:, None, None] ** 2 * direction)

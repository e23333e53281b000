"""Report and delete: which tracks are told to the user, and which end.

Report: the tracks of sufficient existence that are detected, or that are in a field of view at a place that is known
well enough.

Each has a score and a calibrated covariance:

    score       max(p, g m) ( hits / (opportunities + prior_opportunities) )^w     while coasting times r v
    P_reported  = ( c (1 + h (1 - p)) )^2 P + ( b (1 + k (1 - p)) )^2 u u^T

The score rests on all evidence of the track so far: p is the probability of its latest detection, m that of its best
one, g the share of it that lasts, r the existence, v the visibility (`saga_fg.tracking.visibility`). It is monotone in
the evidence: a higher probability of any detection lowers no score of the track, then or later, and neither does one
more hit. A weak detection leaves the share g, and a gap multiplies the scores of the boxes in it by r v: misses lower r
where the object should have been seen, and v where it may be hidden.

A filter's noise is wider than its errors where it also has to let the right detections through the gate, which are not
as Gaussian as it assumes: the factor c, of sensor and class, corrects this, and h its dependence on the probability p
of the latest detection. A detector that sees one side of a car misjudges its length, and with it the position of its
centre along the heading u, in one frame as in the next. No filter averages that away: the position bias b. Both are for
the report; the filter and the association, which compare detections with detections, do without them. c, b and their
growth are the sensor's noise settings, see `saga_fg.model.sensor`.

Delete: tracks without detections whose place is no longer known, and those that are not likely to exist.

A track lives on while its place is known to `max_deviation`, as it is then reported, or while it could be re-linked,
at most for `max_coasting`. Neighbours that are still detected keep its place known for longer. Deleted tracks are
marginalised, so that their information on their neighbours stays.
"""

import logging
from typing import Any

import numpy as np

from saga_fg.kernels.components import biased_covariances
from saga_fg.numerics import BoolArray, FloatArray, IntArray, unchecked
from saga_fg.tracking.relinking import relinkable
from saga_fg.tracking.settings import ExistenceSettings
from saga_fg.tracking.track_table import TrackTable
from saga_fg.tracking.tracker_state import TrackerState
from saga_fg.types import Boxes, Tracks

LASTING_SHARE = 0.3  # of the best detection's probability, which later boxes score at least; 0.2 to 0.5 rank alike


def report_tracks(state: TrackerState, timestamp: float) -> Tracks:
    """The tracks to be reported, as of `timestamp` (s): arrays of their own, read-only."""
    table, settings, rows = state.table, state.settings, reported_rows(state)
    coasting = table.coasting(state.time)[rows]
    now = state.reported_kinematics(rows)
    yaw, (scale, bias) = table.box.yaw[rows], (table.covariance_scale[rows], table.position_bias[rows])
    centre = np.concatenate([now.position + state.origin, table.box.z[rows, None]], axis=1)
    P = biased_covariances(now.P, yaw, scale, bias)
    score = reported_score(table, rows, coasting > 0, settings.existence)
    score = score * state.confused.certainty(state.class_belief()[rows])
    if settings.tentative_score_factor < 1:
        score = np.where(table.tentative(state.time)[rows], settings.tentative_score_factor * score, score)
    columns = {"label": table.label[rows], "position": centre, "size": table.box.size.take(rows, 0)}
    boxes = unchecked(Boxes, **_frozen(columns | {"yaw": yaw, "velocity": now.velocity}))
    columns = {"id": table.id[rows], "score": score, "coasting": coasting}
    columns["settled"] = state.joint.settled(columns["id"])
    covariances = {"position_covariance": P, "velocity_covariance": now.P_velocity}
    return unchecked(Tracks, timestamp=timestamp, boxes=boxes, **_frozen(columns | covariances))


def _frozen(columns: dict[str, Any]) -> dict[str, Any]:
    """Columns that nobody else has, which cannot be written from now on."""
    for column in columns.values():
        column.flags.writeable = False
    return columns


def reported_rows(state: TrackerState) -> IntArray:
    """Rows of the tracks to be reported."""
    table, settings = state.table, state.settings
    coasting = table.coasting(state.time)
    chosen = table.confirmed | (table.seen_existence >= settings.existence.report_above)
    if settings.tentative_score_factor == 0:
        chosen &= ~table.tentative(state.time)
    in_view = (table.sensors.seen_by_any() > 0) | settings.report_out_of_view
    chosen &= (coasting == 0) | ((coasting <= settings.report_coasting) & in_view & known_places(state))
    return chosen.nonzero()[0]


def known_places(state: TrackerState) -> BoolArray:
    """(n,) tracks whose places, should they move, are known to the `max_deviation` of their class."""
    (most,) = state.class_values(state.table.label, "max_deviation")
    return np.asarray(state.kinematics().deviation <= most)


def reported_score(table: TrackTable, rows: IntArray, coasting: BoolArray, settings: ExistenceSettings) -> FloatArray:
    """(k,) score of the boxes of tracks `rows` (k,); coasting (k,): not detected now."""
    hits, opportunities = table.sensors.best_hits()
    hit_ratio = (hits[rows] / (opportunities[rows] + settings.prior_opportunities)) ** settings.hit_ratio_weight
    evidence = np.maximum(table.score[rows], LASTING_SHARE * table.best_score[rows])
    return np.asarray(evidence * hit_ratio * np.where(coasting, table.seen_existence[rows], 1.0))


log = logging.getLogger(__name__)


def delete_tracks(state: TrackerState) -> None:
    """Delete the tracks that have come to their end at the state's time."""
    table, settings = state.table, state.settings
    detected = np.zeros(len(table), dtype=bool)
    detected[table.rows(state.assignment.id)] = True  # perhaps by a late frame
    deleted = ~(detected | known_places(state) | relinkable(state))
    deleted |= table.coasting(state.time) > settings.max_coasting
    deleted |= ~table.confirmed & (table.seen_existence < settings.existence.delete_below)
    deleted |= untrackable(state)
    state.remove(deleted)


def untrackable(state: TrackerState) -> BoolArray:
    """(n,) tracks whose states are out of bounds."""
    deleted = ~state.kinematics().within_limits(state.origin)
    if deleted.any():
        log.warning("deleted, since their states are out of bounds: tracks %s", state.table.id[deleted].tolist())
    return deleted

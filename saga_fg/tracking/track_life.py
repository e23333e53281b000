"""Tracks from their first detection to their last: which begin, which are tentative, are told to the user, and end.

Unresolved tracks are new ones over a live track of their class, of whose object they may be a second detection.
Detectors report one object as two or three boxes, above all in crowds and rows of parked ones. Two objects of a class
hardly ever overlap: of labelled cars on nuScenes 0.1 % have a bird's-eye IoU above 0.02 with another one, of
pedestrians 5 % one above 0.05 and 0.1 % one above 0.2. A new track that overlaps a surer one by more than `OVERLAP` is
therefore unresolved, that is tentative. A number of frames is left until it counts as an object of its own: `FRAMES` at
its start, at most `MAX_FRAMES`, and resolved at 0. Each frame changes it:

    the track                                                         surer tracks that it overlaps   frames left
    detected, overlap with every surer track at most `OVERLAP`        any                             - 1
    detected, largest overlap between `OVERLAP` and `MAX_OVERLAP`    one of them is detected         - 1
    detected, otherwise                                               any                             unchanged
    missed                                                            one of them is detected         + `ALONE`
    missed                                                            none is detected                unchanged

Until it is resolved its detections don't raise its existence, and while it overlaps a confirmed track it is matched to
what the other tracks leave, so that it can't take their detections.

A surer track is one of at least its existence that is not unresolved itself. Boxes of unknown size or heading overlap
nothing, and where the positions of a sensor are uncertain by most of the box's width, overlap tells nothing.

Initiate: detections that belong to no track, and are probable enough, begin new ones.

A new track begins with its measurement and the prior of its class: where no velocity was measured, with that of the
traffic around it (`saga_fg.tracking.traffic`). Returns of lost objects are left out before
(`saga_fg.tracking.relinking`); a new track over another one is tentative.

Report: the tracks of sufficient existence that are detected, or that are in a field of view at a place that is known
well enough.

Each has a score and a calibrated covariance:

    score       max(p, g m) ( hits / (opportunities + prior_opportunities) )^w     while coasting times r v
    P_reported  = ( c (1 + h (1 - p)) )^2 P + ( b (1 + k (1 - p)) )^2 u u^T

The score rests on all evidence of the track so far: p is the probability of its latest detection, m that of its best
one, g the share of it that lasts, r the existence, v the visibility (`saga_fg.tracking.update`). It is monotone in
the evidence: a higher probability of any detection lowers no score of the track, then or later, and neither does one
more hit. A weak detection leaves the share g, and a gap multiplies the scores of the boxes in it by r v: misses lower r
where the object should have been seen, and v where it may be hidden.

Boxes of different classes that overlap by more than `MAX_OVERLAP` are hypotheses of one object, unless a rule of the
graph attaches the one class to the other. The surer one is that of the higher score with its best detection, s. Above
`ALIKE` the class is in doubt, as of a car or a truck, where a detector's scores are shares of one: the other one scores
at most one less the score of the surer. Below, one is part of the other, as a pedestrian on a bicycle: it has 1 - s of
its score.

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
from saga_fg.model import Attached
from saga_fg.numerics import BoolArray, FloatArray, IntArray, Matching, of_classes, unchecked
from saga_fg.tracking.measurements import FrameMeasurements
from saga_fg.tracking.relinking import CONFIRMING, initiating, relinkable
from saga_fg.tracking.settings import ExistenceSettings
from saga_fg.tracking.track_filters import BoxFilter, Kinematics, Stationarity, TurnRate, after_evidence, log_density
from saga_fg.tracking.track_table import TrackTable
from saga_fg.tracking.tracker_state import TrackerState
from saga_fg.tracking.update import update_range_rates
from saga_fg.types import Boxes, Tracks, paired_bev_iou, touching_pairs

OVERLAP = 0.05  # bird's-eye IoU above which a new track is unresolved
MAX_OVERLAP = 0.2  # largest one of two objects, of one class or two
ALIKE = 0.6  # of boxes of two classes, above which neither is part of the other
PRECISE = 0.75  # standard deviation of a position, in widths of its box, up to which overlap tells anything
FRAMES = 2.0  # frames at the start: a box clear of the other three times in all is hardly a second one by chance
ALONE = 2.0  # frames for a miss: an object is missed less often than a second box, so a miss tells more
MAX_FRAMES = 6.0  # frames at most: who walked off counts after so many, whatever was before


def unresolved_frames(
    state: TrackerState, matching: Matching, boxes: Boxes, probability: FloatArray, R: FloatArray
) -> FloatArray:
    """(k,) frames that it takes to resolve new tracks, 0 for resolved ones.

    boxes (k), world, of their detections, which have a probability (k,) and positions of covariance R (k, 2, 2), m^2.
    Only surer tracks that were detected in the frame count: a box over a coasting track may be that track's object. Of
    new tracks over each other the more probable one is surer.
    """
    rank = np.empty(len(boxes))
    rank[np.argsort(-probability, kind="stable")] = np.arange(len(boxes))
    detected, now = matching.track, state.kinematics()
    live = state.boxes(now.position, now.velocity).select(detected)
    others = Boxes.concatenate([boxes, live])
    row, column = touching_pairs(boxes, others)
    other = (column != row).nonzero()[0]  # of new ones, all touch themselves
    row, column = row[other], column[other]
    is_new = column < len(boxes)
    surer = np.empty(len(row), dtype=bool)
    surer[is_new] = rank[column[is_new]] < rank[row[is_new]]
    track = detected[column[~is_new] - len(boxes)]
    surer[~is_new] = (state.table.unresolved[track] == 0) & (state.table.existence[track] >= probability[row[~is_new]])
    row, column = row[surer], column[surer]
    covered = _largest(_overlaps(state, boxes, others, row, column), row, len(boxes)) > OVERLAP
    precise = np.sqrt(np.linalg.eigvalsh(R)[:, -1]) < PRECISE * boxes.size[:, :2].min(axis=1)
    return np.where(covered & precise, FRAMES, 0.0)


def resolve_tracks(state: TrackerState, matching: Matching) -> None:
    """Count the evidence of a frame that unresolved tracks are objects of their own."""
    table = state.table
    detected = np.zeros(len(table), dtype=bool)
    detected[matching.track] = True
    rows = (table.unresolved > 0).nonzero()[0]
    if len(rows) == 0:
        return
    now = state.kinematics()
    boxes = state.boxes(now.position, now.velocity)
    sure = ((table.unresolved == 0) & (table.existence >= table.existence[rows].min())).nonzero()[0]
    mine, theirs = boxes.select(rows), boxes.select(sure)
    row, column = touching_pairs(mine, theirs)
    surer = table.existence[sure[column]] >= table.existence[rows[row]]
    row, column = row[surer], column[surer]
    overlap = _overlaps(state, mine, theirs, row, column)
    most, seen, other = _largest(overlap, row, len(rows)), detected[rows], np.zeros(len(rows), dtype=bool)
    other[row[(overlap > OVERLAP) & detected[sure[column]]]] = True
    apart = (most <= OVERLAP) | (other & (most <= MAX_OVERLAP))
    step = np.where(seen, -1.0 * apart, ALONE * other)
    table.unresolved[rows] = np.clip(table.unresolved[rows] + step, 0.0, MAX_FRAMES)


def over_confirmed(state: TrackerState, predicted: Boxes) -> BoolArray:
    """(n,) unresolved tracks whose predicted box overlaps that of a confirmed track; predicted (n), world."""
    table = state.table
    rows = (table.unresolved > 0).nonzero()[0]
    result = np.zeros(len(table), dtype=bool)
    if len(rows):
        sure = (table.confirmed & (table.unresolved == 0)).nonzero()[0]
        mine, theirs = predicted.select(rows), predicted.select(sure)
        row, column = touching_pairs(mine, theirs)
        result[rows] = _largest(_overlaps(state, mine, theirs, row, column), row, len(rows)) > OVERLAP
    return result


def _overlaps(state: TrackerState, boxes: Boxes, others: Boxes, row: IntArray, column: IntArray) -> FloatArray:
    """(K,) bird's-eye IoU of boxes[row] with others[column] of their class or group, 0 with those of other classes."""
    overlap = np.zeros(len(row))
    alike = state.confused.alike(boxes.label[row], others.label[column]).nonzero()[0]
    found = paired_bev_iou(boxes.select(row[alike]), others.select(column[alike]))
    overlap[alike] = np.where(np.isnan(found), 0.0, found)
    return overlap


def _largest(overlap: FloatArray, row: IntArray, count: int) -> FloatArray:
    """(count,) largest of the overlaps (K,) of each row, 0 where there is none."""
    largest = np.zeros(count)
    np.maximum.at(largest, row, overlap)
    return largest


def initiate_tracks(state: TrackerState, measurements: FrameMeasurements, matching: Matching) -> IntArray:
    """Append new tracks; returns the rows of their measurements, whose delay the tracks are predicted by."""
    rows = initiating(state, measurements, matching)
    if len(rows) == 0:
        return rows
    k, delay, boxes, p = len(rows), measurements.delay, measurements.boxes.select(rows), measurements.probability[rows]
    ids = np.arange(state.next_id, state.next_id + k, dtype=np.int64)
    state.next_id += k
    unresolved = unresolved_frames(state, matching, boxes, p, measurements.R[rows, :2, :2])
    kinematics, stationary = initial_kinematics(state, measurements, rows, boxes)
    relative = None if measurements.relative is None else measurements.relative.select(rows)
    state.joint.add(ids, boxes.label, kinematics, delay, relative, appended=True)
    update_range_rates(state, measurements, rows, ids, boxes.label, np.ones(k))
    time, alone = state.time - delay, measurements.sensor.initiation == "alone"
    z_noise, yaw_noise = measurements.z_noise[rows], measurements.yaw_noise[rows]
    new = TrackTable(
        ids,
        boxes.label,
        existence=p.copy(),
        last_existence=p.copy(),
        score=p.copy(),
        best_score=p.copy(),
        covariance_scale=measurements.covariance_scale[rows],
        position_bias=measurements.position_bias[rows],
        initiated=np.full(k, time),
        last_detected=np.full(k, time),
        confirmed=(p >= state.settings.existence.confirm_above) & (unresolved == 0),
        has_moved=np.zeros(k, dtype=bool),
        required_hits=np.full(k, float(state.settings.min_hits if alone else CONFIRMING)),
        overlooked=np.full(k, np.nan if alone else -np.inf),
        unresolved=unresolved,
        class_belief=state.confused.initial(measurements.class_likelihood[rows]),
        box=BoxFilter.initiated(boxes.size, p, boxes.position[:, 2], z_noise, boxes.yaw, yaw_noise),
        stationarity=Stationarity.initiated(kinematics, stationary),
        turn=TurnRate.initiated(boxes.yaw, yaw_noise),
        sensors=state.table.sensors.initiated(measurements.name, p, time),
    )
    state.table = state.table.append(new)
    return rows


def initial_kinematics(
    state: TrackerState, measurements: FrameMeasurements, rows: IntArray, boxes: Boxes
) -> tuple[Kinematics, FloatArray]:
    """The kinematics of new tracks from the measurements `rows` (k,), with their boxes, if they move; and the
    probability (k,) that they are stationary."""
    R, prior, measured = measurements.R[rows], state.settings.stationary_share, measurements.with_velocity[rows]
    place = boxes.position[:, :2]
    velocity, P_velocity, stationary = state.unmeasured_velocity(boxes.label, place, boxes.yaw, prior)
    if not measured.any():
        return Kinematics(place - state.origin, velocity, R[:, :2, :2], P_velocity), stationary
    if prior > 0:
        z, R_v = np.nan_to_num(boxes.velocity), R[:, 2:, 2:]
        evidence = log_density(z, R_v) - log_density(z - velocity, P_velocity + R_v)
        stationary = np.where(measured, after_evidence(stationary, evidence), stationary)
    kinematics = Kinematics(
        place - state.origin,
        np.where(measured[:, None], boxes.velocity, velocity),
        R[:, :2, :2],
        np.where(measured[:, None, None], R[:, 2:, 2:], P_velocity),
    )
    return kinematics, stationary


LASTING_SHARE = 0.3  # of the best detection's probability, which later boxes score at least; 0.2 to 0.5 rank alike


def report_tracks(state: TrackerState, timestamp: float) -> Tracks:
    """The tracks to be reported, as of `timestamp` (s): arrays of their own, read-only."""
    table, settings, rows = state.table, state.settings, reported_rows(state)
    coasting = table.coasting(state.time)[rows]
    now = state.reported_kinematics(rows)
    yaw, (scale, bias) = table.box.yaw[rows], (table.covariance_scale[rows], table.position_bias[rows])
    centre = np.concatenate([now.position + state.origin, table.box.z[rows, None]], axis=1)
    P = biased_covariances(now.P, yaw, scale, bias)
    score, best = reported_score(table, rows, coasting > 0, settings.existence)
    score = score * state.confused.certainty(state.class_belief()[rows])
    if settings.tentative_score_factor < 1:
        score = np.where(table.tentative(state.time)[rows], settings.tentative_score_factor * score, score)
    columns = {"label": table.label[rows], "position": centre, "size": table.box.size.take(rows, 0)}
    boxes = unchecked(Boxes, **_frozen(columns | {"yaw": yaw, "velocity": now.velocity}))
    score = exclusive_score(state, boxes, score, best)
    columns = {"id": table.id[rows], "score": score, "coasting": coasting}
    columns["settled"] = state.joint.settled(columns["id"])
    covariances = {"position_covariance": P, "velocity_covariance": now.P_velocity}
    relations = state.right_of_way.relations(columns["id"])
    return unchecked(Tracks, timestamp=timestamp, boxes=boxes, relations=relations, **_frozen(columns | covariances))


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


def reported_score(
    table: TrackTable, rows: IntArray, coasting: BoolArray, settings: ExistenceSettings
) -> tuple[FloatArray, FloatArray]:
    """(k,) scores of the boxes of tracks `rows` (k,), and what they are with the best detection of each.

    coasting  (k,) not detected now
    """
    hits, opportunities = table.sensors.best_hits()
    share = (hits[rows] / (opportunities[rows] + settings.prior_opportunities)) ** settings.hit_ratio_weight
    evidence, best = np.maximum(table.score, LASTING_SHARE * table.best_score)[rows], table.best_score[rows]
    return np.asarray(evidence * share * np.where(coasting, table.seen_existence[rows], 1.0)), np.asarray(best * share)


def exclusive_score(state: TrackerState, boxes: Boxes, score: FloatArray, best: FloatArray) -> FloatArray:
    """(k,) scores of reported boxes (k), which had `score` (k,), where boxes of other classes are in their place.

    best  (k,) scores with the best detection of each track
    """
    a, b = touching_pairs(boxes, boxes)
    rival = (a < b) & ~state.confused.alike(boxes.label[a], boxes.label[b])
    for rule in state.rules:
        if isinstance(rule, Attached):
            part, carrier = of_classes(boxes.label, rule.attached), of_classes(boxes.label, rule.carriers)
            rival &= ~((part[a] & carrier[b]) | (part[b] & carrier[a]))
    a, b = a[rival], b[rival]
    overlap = np.nan_to_num(paired_bev_iou(boxes.select(a), boxes.select(b)))
    sure, other = np.where(best[a] >= best[b], [a, b], [b, a])[:, overlap > MAX_OVERLAP]
    alike = overlap[overlap > MAX_OVERLAP] > ALIKE
    result = score.copy()
    np.minimum.at(result, other, np.where(alike, 1 - score[sure], (1 - best[sure]) * score[other]))
    return result


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

"""Initiate: new tracks, those that may be second detections, and those that are returns of lost ones.

Unresolved tracks: new ones over a live track of their class, of whose object they may be a second detection.

Detectors report one object as two or three boxes, above all in crowds and rows of parked ones. Two objects of a class
hardly ever overlap: of labelled cars on nuScenes 0.1 % have a bird's-eye IoU above 0.02 with another one, of
pedestrians 5 % one above 0.05 and 0.1 % one above 0.2. A new track that overlaps a surer one by more than `OVERLAP` is
therefore unresolved, that is tentative. A number of frames is left until it counts as an object of its own: `FRAMES` at
its start, at most `MOST_FRAMES`, and resolved at 0. Each frame changes it:

    the track                                                         surer tracks that it overlaps   frames left
    detected, overlap with every surer track at most `OVERLAP`        any                             - 1
    detected, largest overlap between `OVERLAP` and `MOST_OVERLAP`    one of them is detected         - 1
    detected, otherwise                                               any                             unchanged
    missed                                                            one of them is detected         + `ALONE`
    missed                                                            none is detected                unchanged

Until it is resolved its detections don't raise its existence, and while it overlaps a confirmed track it is matched to
what the other tracks leave, so that it can't take their detections.

A surer track is one of at least its existence that is not unresolved itself. Boxes of unknown size or heading overlap
nothing, and where the positions of a sensor are uncertain by most of the box's width, overlap tells nothing.

Re-link: a detection that would initiate a track may be the return of an object that has a track already.

    odds_ij = r_i e^(-T_i / lifetime) ( (1 - s_i) N(z_j; m_i, P_i + R_j) + s_i N(z_j; a_i, D_i + R_j) ) / density
    density = (number of detections of the class that would initiate tracks) / area

are the odds that detection j is track i, not detected for T_i s, against its being one of the others, anywhere in the
area. N(m, P) is the state in the joint filter, so that neighbours that are still detected count; s is the probability
that the object is stationary, N(a, D) its place if it is. r is the existence of the track *at its latest detection*.

This pass comes after the assignment (`saga_fg.tracking.association`), which asks another question: whether a detection
is of a track that was missed a few times, or false. There existence counts, which collapses with each miss. Here the
detection counts as an object in any case, and misses in a row tell no more than that the object was hidden: they are
not independent. So a track competes for detections with others only while it has just been detected.

A track whose place is so uncertain that no detection could be re-linked with it, of all places at its predicted one,
is of no use, see `relinkable`: well-seen objects and stationary ones are remembered for longer.

Source: Reid, An Algorithm for Tracking Multiple Targets, IEEE Transactions on Automatic Control 24(6), 1979: the
densities of a continued and of a new target.

Hand over: a new track proves to be the return of an object that has a track already, and takes its identity.

    odds = r e^(-T / lifetime) (moving + stationary) / density,   density = (new tracks of the class) / area
    moving     = (1 - s) (1 - s') / (1 - p)  N(m' - m; 0, P + P') / N(0; 0, V)          over position and velocity
    stationary = s s' / p  N(a' - a; 0, D + D')                                          over position

A return that begins with a weak detection, or far from where it was expected, initiates a track. With each further
detection of the new track the question is asked again, with all its detections: what they say about the object is its
filtered state (' above) divided by its prior. That is a velocity of covariance V, a probability p to be stationary, and
a position anywhere in the area. Of the velocity's prior its peak counts, so that no odd velocity speaks for a re-link.
r is the existence of the old track at its latest detection, N(m, P) its state, s its probability to be stationary,
N(a, D) its place if it is.

The old track is then updated with the state of the new one, as with a measurement of position and velocity, and the
new one is marginalised. Only a track that has been detected up to `CONFIRMING` times hands over, is
resolved, and had its first detection after the latest one of the old track.

Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 8.4:
tests whether two tracks are of one object, and their fusion, errors taken for independent.
"""

from __future__ import annotations

import math

import numpy as np

from saga_fg.kernels.components import velocities_along
from saga_fg.kernels.pairs import relinking_pairs, return_evidence, returned_pairs
from saga_fg.kernels.tracks import log_peaks
from saga_fg.model.interactions import POSITION, VELOCITY
from saga_fg.model.sensor import Sensor
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, StrArray, common_numbers
from saga_fg.numerics.assignment import Matching, least_total, mahalanobis_of_pairs
from saga_fg.tracking.measurements import FrameMeasurements
from saga_fg.tracking.track_filters import BoxFilter, Kinematics, Stationarity, TurnRate, after_evidence, log_density
from saga_fg.tracking.track_table import TrackTable
from saga_fg.tracking.tracker_state import LIFETIME, TrackerState
from saga_fg.tracking.traffic import speed_prior
from saga_fg.tracking.update import update_range_rates
from saga_fg.types.boxes import Boxes, paired_bev_iou, touching_pairs

_ROUNDING = 1 + 1e-6
CONFIRMING = 3  # detections that confirm a track of one sensor, and up to which it may be an earlier one; usual 2 to 5
NOMINAL_AREA = 5000.0  # m^2, where `clutter_area` is infinite: a disc of 40 m, in which most objects are detected


def relinked(
    state: TrackerState, measurements: FrameMeasurements, matching: Matching, position: FloatArray, P: FloatArray
) -> Matching:
    """The matching, with the returns of tracks that it left unmatched.

    position  (n, 2) of the tracks at the time of the frame, local, m; P (n, 2, 2) their covariances
    """
    rows = initiating(state, measurements, matching)
    if len(rows) == 0:
        return matching
    free = relinkable(state)
    free[matching.track] = False
    tracks, label = free.nonzero()[0], measurements.boxes.label[rows]
    if len(tracks) == 0:
        return matching
    places, noise = measurements.boxes.position[rows, :2] - state.origin, measurements.R[rows, :2, :2]
    t, j, cost = _pairs(state, tracks, position, P, label, places, noise)
    if len(t) == 0:
        return matching
    chosen = least_total(t, j, cost)
    t, j = t[chosen], j[chosen]
    distance, _ = mahalanobis_of_pairs(places[j] - position[t], P[t] + noise[j])
    return matching.append(Matching(t, rows[j], distance))


def _pairs(
    state: TrackerState,
    tracks: IntArray,
    position: FloatArray,
    P: FloatArray,
    label: StrArray,
    z: FloatArray,
    R: FloatArray,
) -> tuple[IntArray, IntArray, FloatArray]:
    """Rows of tracks, of places `z` (m, 2) of classes `label` (m,), and costs (k,) of pairs
    that re-linking pays for."""
    still = state.table.stationarity
    group, of_place = common_numbers(state.table.label, label)
    log_density = np.log(np.bincount(of_place)[of_place] / area(state))
    objects = position, P, still.position, still.P, still.probability, log_survival(state)
    return relinking_pairs(tracks, group, *objects, z, R, of_place, log_density, least_log_odds(state), _ROUNDING)


def relinkable(state: TrackerState) -> BoolArray:
    """(n,) tracks with which a detection at their predicted place, and no other in the area, would be re-linked."""
    association, table = state.settings.association, state.table
    if association.relink_above == 1 or len(table) == 0:
        return np.zeros(len(table), dtype=bool)
    still = table.stationarity
    peaks = log_peaks(state.kinematics().P, still.P, still.probability, log_survival(state))
    within = table.coasting(state.time) <= state.settings.max_coasting
    return np.asarray(within & (peaks >= least_log_odds(state) - math.log(area(state))))


def initiating(state: TrackerState, measurements: FrameMeasurements, matching: Matching) -> IntArray:
    """Rows of the unmatched measurements that are probable enough to initiate a track."""
    free = np.ones(len(measurements), dtype=bool)
    free[matching.detection] = False
    initiation_score = state.class_values(measurements.boxes.label, "initiation_score")[0]
    probable: IntArray = (free & (measurements.probability >= initiation_score)).nonzero()[0]
    return probable


def area(state: TrackerState) -> float:
    """Area over which objects spread, m^2: a sensor's own `clutter_area` says how its false detections do."""
    clutter_area = state.settings.association.clutter_area
    return clutter_area if math.isfinite(clutter_area) else NOMINAL_AREA


def least_log_odds(state: TrackerState) -> float:
    """Log-odds from which a track is re-linked."""
    above = state.settings.association.relink_above
    return math.log(above / (1 - above))


def log_survival(state: TrackerState) -> FloatArray:
    """(n,) log of the probability that the track is an object that is still there."""
    table = state.table
    real = np.maximum(table.last_existence, 1e-3)
    return np.asarray(np.log(real) - table.coasting(state.time) / LIFETIME)


OVERLAP = 0.05  # bird's-eye IoU above which a new track is unresolved
MOST_OVERLAP = 0.2  # largest one of two objects
PRECISE = 0.75  # standard deviation of a position, in widths of its box, up to which overlap tells anything
FRAMES = 2.0  # frames at the start: a box clear of the other three times in all is hardly a second one by chance
ALONE = 2.0  # frames for a miss: an object is missed less often than a second box, so a miss tells more
MOST_FRAMES = 6.0  # frames at most: who walked off counts after so many, whatever was before


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
    if len(other) == 0:
        return np.zeros(len(boxes))
    row, column = row[other], column[other]
    is_new = column < len(boxes)
    surer = np.empty(len(row), dtype=bool)
    surer[is_new] = rank[column[is_new]] < rank[row[is_new]]
    track = detected[column[~is_new] - len(boxes)]
    surer[~is_new] = (state.table.unresolved[track] == 0) & (state.table.existence[track] >= probability[row[~is_new]])
    row, column = row[surer], column[surer]
    covered = _largest(_overlaps(boxes, others, row, column), row, len(boxes)) > OVERLAP
    if not covered.any():
        return np.zeros(len(boxes))
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
    overlap = _overlaps(mine, theirs, row, column)
    most, seen, other = _largest(overlap, row, len(rows)), detected[rows], np.zeros(len(rows), dtype=bool)
    other[row[(overlap > OVERLAP) & detected[sure[column]]]] = True
    apart = (most <= OVERLAP) | (other & (most <= MOST_OVERLAP))
    step = np.where(seen, -1.0 * apart, ALONE * other)
    table.unresolved[rows] = np.clip(table.unresolved[rows] + step, 0.0, MOST_FRAMES)


def over_confirmed(state: TrackerState, predicted: Boxes) -> BoolArray:
    """(n,) unresolved tracks whose predicted box overlaps that of a confirmed track; predicted (n), world."""
    table = state.table
    rows = (table.unresolved > 0).nonzero()[0]
    result = np.zeros(len(table), dtype=bool)
    if len(rows):
        sure = (table.confirmed & (table.unresolved == 0)).nonzero()[0]
        mine, theirs = predicted.select(rows), predicted.select(sure)
        row, column = touching_pairs(mine, theirs)
        result[rows] = _largest(_overlaps(mine, theirs, row, column), row, len(rows)) > OVERLAP
    return result


def _overlaps(boxes: Boxes, others: Boxes, row: IntArray, column: IntArray) -> FloatArray:
    """(K,) bird's-eye IoU of boxes[row] with others[column] of their class, 0 with those of other classes."""
    overlap = np.zeros(len(row))
    alike = (boxes.label[row] == others.label[column]).nonzero()[0]
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
    update_range_rates(state, measurements, rows, ids, boxes.label)
    time = state.time - delay
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
        last_in_view=np.full(k, state.time),
        confirmed=(p >= state.settings.existence.confirm_above) & (unresolved == 0),
        has_moved=np.zeros(k, dtype=bool),
        required_hits=np.full(k, required_hits(state, measurements.sensor)),
        unresolved=unresolved,
        box=BoxFilter.initiated(boxes.size, p, boxes.position[:, 2], z_noise, boxes.yaw, yaw_noise),
        stationarity=Stationarity.initiated(kinematics, stationary),
        turn=TurnRate.initiated(boxes.yaw, yaw_noise),
        sensors=state.table.sensors.initiated(measurements.name, p, time),
    )
    state.table = state.table.append(new)
    return rows


def required_hits(state: TrackerState, sensor: Sensor) -> float:
    """Detections of a sensor alone that confirm a track which it has initiated."""
    return float(state.settings.min_hits if sensor.initiation == "alone" else CONFIRMING)


def initial_kinematics(
    state: TrackerState, measurements: FrameMeasurements, rows: IntArray, boxes: Boxes
) -> tuple[Kinematics, FloatArray]:
    """The kinematics of new tracks from the measurements `rows` (k,), with their boxes, if they move; and the
    probability (k,) that they are stationary."""
    R, prior, measured = measurements.R[rows], state.settings.stationary_share, measurements.with_velocity[rows]
    place = boxes.position[:, :2]
    velocity, P_velocity, stationary = unmeasured_velocity(state, boxes.label, place, boxes.yaw, prior)
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


def unmeasured_velocity(
    state: TrackerState, label: StrArray, place: FloatArray, yaw: FloatArray, prior: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Velocity (k, 2), its covariance (k, 2, 2) and the probability (k,) to be stationary, by class, place (k, 2) in
    the world, heading (k,), rad, and traffic."""
    speed, drift = state.class_values(label, "initial_speed_deviation", "initial_lateral_speed_deviation")
    stationary, mean, variance = speed_prior(state.traffic, label, place, yaw, speed**2, prior)
    return *velocities_along(yaw, mean, variance, speed, drift), stationary


_FARTHEST = 100.0  # squared distance of two positions from which not even the narrowest densities join tracks


def hand_over(state: TrackerState, matching: Matching) -> Matching:
    """Join new tracks to the old ones whose objects they are; returns the matching by the rows that are left."""
    new, old, others = _candidates(state, matching)
    if len(new) == 0:
        return matching
    moving, still = _log_evidence(state, new, old)
    evidence = np.logaddexp(moving, still)
    log_odds = log_survival(state)[old] + evidence + math.log(area(state)) - np.log(others)
    chosen = least_total(new, old, least_log_odds(state) - log_odds)
    if len(chosen) == 0:
        return matching
    new, old = new[chosen], old[chosen]
    _join(state, old, new, np.exp(still - evidence)[chosen])
    row, kept = np.arange(len(state)), np.ones(len(state), dtype=bool)
    row[new], kept[new] = old, False
    state.remove(~kept)
    return Matching((np.cumsum(kept) - 1)[row[matching.track]], matching.detection, matching.distance)


def _candidates(state: TrackerState, matching: Matching) -> tuple[IntArray, IntArray, IntArray]:
    """Pairs of rows (k,): new tracks just detected, and old ones of their class; the number (k,) of such new tracks."""
    table, settings = state.table, state.settings
    resolved, detected = table.unresolved == 0, np.zeros(len(table), dtype=bool)
    detected[matching.track] = settings.association.relink_above < 1
    detections = table.sensors.hits.sum(axis=1)
    new = (detected & resolved & (detections > 1) & (detections <= CONFIRMING)).nonzero()[0]
    if len(new) == 0:
        return new, new, new
    old = (~detected & resolved & (table.coasting(state.time) <= settings.max_coasting)).nonzero()[0]
    now, still = state.kinematics(), table.stationarity
    (group,), places = common_numbers(table.label), (now.position, now.P, still.position, still.P)
    return returned_pairs(new, old, group, table.initiated, table.last_detected, *places, _FARTHEST)


def _log_evidence(state: TrackerState, new: IntArray, old: IntArray) -> tuple[FloatArray, FloatArray]:
    """(k,) logs of `moving` and `stationary`, see the module."""
    table, prior = state.table, state.settings.stationary_share
    first = np.ones(len(new), dtype=bool)
    first[1:] = new[1:] != new[:-1]  # a new track is in many pairs, one after the other
    each, of_pair = new[first], first.cumsum() - 1
    place = state.kinematics().position[each] + state.origin
    _, V_0, p = unmeasured_velocity(state, table.label[each], place, table.box.yaw[each], prior)
    estimator, still = state.joint.estimator, table.stationarity
    places, place, D, s = state.joint.places(table.label), still.position, still.P, still.probability
    (x, P), (x_old, P_old) = (estimator.planar_marginals(table.id[k], places[k]) for k in (new, old))
    if_still = s[new], s[old], place[new] - place[old], D[new] + D[old]
    return return_evidence(x, P, x_old, P_old, places[new, 2] >= 0, V_0[of_pair], p[of_pair], *if_still)


def _join(state: TrackerState, old: IntArray, new: IntArray, stationary: FloatArray) -> None:
    """Update tracks `old` (k,) with all that is known of tracks `new` (k,); stationary (k,): then, the probability."""
    table, joint, box = state.table, state.joint, state.table.box
    if state.settings.stationary_share > 0:
        place, P = table.stationarity.position[new], np.tile(np.eye(4), (len(new), 1, 1))
        P[:, :2, :2] = table.stationarity.P[new]
        z, without_velocity = np.concatenate([place, 0 * place], axis=1), np.zeros(len(new), dtype=bool)
        table.stationarity.update(old, z, P, state.kinematics().select(old), without_velocity)
        table.stationarity.probability[old] = stationary
    for node_type, rows in joint.rows_by_type(table.label[new], moving=True):
        H = node_type.selector(POSITION + VELOCITY if node_type.has(VELOCITY) else POSITION)
        ids = table.id[new[rows]]
        R = H @ joint.estimator.covariance(ids) @ H.T
        H_of_each = np.broadcast_to(H, (len(rows), *H.shape))
        z = joint.estimator.mean(ids) @ H.T
        joint.measure(node_type, table.id[old[rows]], z, H_of_each, (R + np.swapaxes(R, 1, 2)) / 2, 0.0)
    z_noise, yaw_noise = np.sqrt(box.z_variance[new]), np.sqrt(box.yaw_variance[new])
    box.update(old, box.size[new], box.size_weight[new], box.z[new], z_noise, box.yaw[new], yaw_noise)
    table.turn.update(old, table.turn.heading[new], np.sqrt(table.turn.P[new, 0, 0]))
    table.sensors.join(old, new)
    for column in (table.score, table.covariance_scale, table.position_bias, table.last_detected, table.last_in_view):
        column[old] = column[new]
    table.best_score[old] = np.maximum(table.best_score[old], table.best_score[new])
    table.confirmed[old] |= table.confirmed[new]
    table.has_moved[old] |= table.has_moved[new]
    table.existence[old] = np.maximum(table.existence[old], table.existence[new])
    table.last_existence[old] = table.existence[old]

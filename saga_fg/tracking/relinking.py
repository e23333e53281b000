"""Re-link: objects that were lost and are seen again keep their tracks.

A detection that would initiate a track may be the return of an object that has a track already.

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

import math
from dataclasses import replace

import numpy as np

from saga_fg.kernels.pairs import relinking_pairs, return_evidence, returned_pairs
from saga_fg.model import POSITION, VELOCITY
from saga_fg.numerics import BoolArray, FloatArray, IntArray, Matching, StrArray, least_total, mahalanobis_of_pairs
from saga_fg.tracking.measurements import FrameMeasurements
from saga_fg.tracking.track_filters import log_density
from saga_fg.tracking.tracker_state import LIFETIME, TrackerState

CONFIRMING = 3  # detections that confirm a track of one sensor, and up to which it may be an earlier one; usual 2 to 5
NOMINAL_AREA = 5000.0  # m^2, where `clutter_area` is infinite: a disc of 40 m, in which most objects are detected
_ROUNDING = 1 + 1e-6
_FARTHEST = 100.0  # squared distance of two positions from which not even the narrowest densities join tracks


def relinked(
    state: TrackerState,
    measurements: FrameMeasurements,
    matching: Matching,
    position: FloatArray,
    P: FloatArray,
    own_cost: FloatArray | None = None,
) -> Matching:
    """The matching, with the returns of tracks that it left unmatched.

    position  (n, 2) of the tracks at the time of the frame, local, m; P (n, 2, 2) their covariances
    own_cost  (n, m) of a user's own, None: none
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
    if len(state.confused):
        cost -= _class_odds(state, t, measurements.class_likelihood[rows[j]])
    if own_cost is not None:
        cost = cost + own_cost[t, rows[j]] / 2
    t, j, cost = t[cost < 0], j[cost < 0], cost[cost < 0]
    chosen = least_total(t, j, cost)
    t, j = t[chosen], j[chosen]
    distance, _ = mahalanobis_of_pairs(places[j] - position[t], P[t] + noise[j])
    return matching.append(Matching(t, rows[j], distance, np.ones(len(t))))


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
    group, of_place = state.confused.numbers(state.table.label, label)
    log_others = np.log(np.bincount(of_place)[of_place] / area(state))
    return relinking_pairs(
        tracks=tracks,
        group=group,
        position=position,
        P=P,
        place=still.position,
        D=still.P,
        stationary=still.probability,
        log_survival=log_survival(state),
        z=z,
        R=R,
        group_z=of_place,
        log_density=log_others,
        least=min_log_odds(state),
        rounding=_ROUNDING,
    )


def _log_mixture(stationary: FloatArray, moving: FloatArray, resting: FloatArray) -> FloatArray:
    """(k,) log of a density in the plane, of logs (k,) up to a constant: moving, and resting, with the probability
    `stationary` (k,)."""
    s = np.clip(stationary, 0.0, 1 - 1e-9)
    mixed = np.logaddexp(np.log1p(-s) + moving, np.log(np.maximum(s, 1e-300)) + resting)
    return np.asarray(mixed - math.log(2 * math.pi))


def _class_odds(state: TrackerState, tracks: IntArray, likelihood: FloatArray) -> FloatArray:
    """(k,) log-odds that reports of this likelihood (k, C) are of the classes of `tracks` (k,), not of any; at most 0,
    so that a common class links nothing."""
    confused = state.confused
    of_any = confused.log_evidence(np.where(likelihood > 0, confused.log_prior, -np.inf), likelihood)
    return np.minimum(confused.log_evidence(state.class_belief()[tracks], likelihood) - of_any, 0.0)


def relinkable(state: TrackerState) -> BoolArray:
    """(n,) tracks with which a detection at their predicted place, and no other in the area, would be re-linked."""
    association, table = state.settings.association, state.table
    if association.relink_above == 1 or len(table) == 0:
        return np.zeros(len(table), dtype=bool)
    still = table.stationarity
    moving, resting = (log_density(np.zeros(2), C) for C in (state.kinematics().P, still.P))
    peaks = log_survival(state) + _log_mixture(still.probability, moving, resting)
    within = table.coasting(state.time) <= state.settings.max_coasting
    return np.asarray(within & (peaks >= min_log_odds(state) - math.log(area(state))))


def initiating(state: TrackerState, measurements: FrameMeasurements, matching: Matching) -> IntArray:
    """Rows of the unmatched measurements that are probable enough to initiate a track."""
    free = np.ones(len(measurements), dtype=bool)
    free[matching.detection] = False
    initiation_score = state.class_values(measurements.boxes.label, "initiation_score")[0]
    return np.asarray((free & (measurements.probability >= initiation_score)).nonzero()[0])


def area(state: TrackerState) -> float:
    """Area over which objects spread, m^2: a sensor's own `clutter_area` says how its false detections do."""
    clutter_area = state.settings.association.clutter_area
    return clutter_area if math.isfinite(clutter_area) else NOMINAL_AREA


def min_log_odds(state: TrackerState) -> float:
    """Log-odds from which a track is re-linked."""
    above = state.settings.association.relink_above
    return math.log(above / (1 - above))


def log_survival(state: TrackerState) -> FloatArray:
    """(n,) log of the probability that the track is an object that is still there."""
    table = state.table
    real = np.maximum(table.last_existence, 1e-3)
    return np.asarray(np.log(real) - table.coasting(state.time) / LIFETIME)


def hand_over(state: TrackerState, matching: Matching) -> Matching:
    """Join new tracks to the old ones whose objects they are; returns the matching by the rows that are left."""
    new, old, others = _possible_returns(state, matching)
    if len(new) == 0:
        return matching
    moving, still = _log_evidence(state, new, old)
    evidence = np.logaddexp(moving, still)
    log_odds = log_survival(state)[old] + evidence + math.log(area(state)) - np.log(others)
    if len(state.confused):
        log_odds += _class_odds(state, old, state.confused.report(state.table.class_belief[new]))
    chosen = least_total(new, old, min_log_odds(state) - log_odds)
    if len(chosen) == 0:
        return matching
    new, old = new[chosen], old[chosen]
    state.reclassify(new, state.table.label[old])
    _join(state, old, new, np.exp(still - evidence)[chosen])
    state.reclassify()
    row, kept = np.arange(len(state)), np.ones(len(state), dtype=bool)
    row[new], kept[new] = old, False
    state.remove(~kept)
    return replace(matching, track=(np.cumsum(kept) - 1)[row[matching.track]])


def _possible_returns(state: TrackerState, matching: Matching) -> tuple[IntArray, IntArray, IntArray]:
    """Pairs of rows (k,): new tracks just detected, and old ones of their class; the number (k,) of such new tracks."""
    table, settings = state.table, state.settings
    resolved, detected = table.unresolved == 0, np.zeros(len(table), dtype=bool)
    detected[matching.track] = settings.association.relink_above < 1
    detections = table.sensors.hits.sum(axis=1)
    new = (detected & resolved & (detections > 1) & (detections <= CONFIRMING)).nonzero()[0]
    old = (~detected & resolved & (table.coasting(state.time) <= settings.max_coasting)).nonzero()[0]
    now, still = state.kinematics(), table.stationarity
    (group,) = state.confused.numbers(table.label)
    return returned_pairs(
        new=new,
        old=old,
        group=group,
        initiated=table.initiated,
        last_detected=table.last_detected,
        position=now.position,
        P=now.P,
        place=still.position,
        D=still.P,
        farthest=_FARTHEST,
    )


def _log_evidence(state: TrackerState, new: IntArray, old: IntArray) -> tuple[FloatArray, FloatArray]:
    """(k,) logs of `moving` and `stationary`, see the module."""
    table, prior = state.table, state.settings.stationary_share
    first = np.ones(len(new), dtype=bool)
    first[1:] = new[1:] != new[:-1]  # a new track is in many pairs, one after the other
    each, of_pair = new[first], first.cumsum() - 1
    place = state.kinematics().position[each] + state.origin
    _, V_0, p = state.unmeasured_velocity(table.label[each], place, table.box.yaw[each], prior)
    estimator, still = state.joint.estimator, table.stationarity
    places = state.joint.places(table.label)
    (x, P), (x_old, P_old) = (estimator.planar_marginals(table.id[k], places[k]) for k in (new, old))
    return return_evidence(
        mean=x,
        P=P,
        old_mean=x_old,
        old_P=P_old,
        moves=places[new, 2] >= 0,
        V=V_0[of_pair],
        p=p[of_pair],
        s=still.probability[new],
        old_s=still.probability[old],
        apart=still.position[new] - still.position[old],
        D=still.P[new] + still.P[old],
    )


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
    report = state.confused.report(table.class_belief[new])
    table.class_belief[old] = state.confused.updated(table.class_belief[old], report)
    table.sensors.join(old, new)
    for column in (table.score, table.covariance_scale, table.position_bias, table.last_detected):
        column[old] = column[new]
    table.best_score[old] = np.maximum(table.best_score[old], table.best_score[new])
    table.confirmed[old] |= table.confirmed[new]
    table.has_moved[old] |= table.has_moved[new]
    table.existence[old] = np.maximum(table.existence[old], table.existence[new])
    table.last_existence[old] = table.existence[old]

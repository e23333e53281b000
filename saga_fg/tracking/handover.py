r"""Hand over: a new track proves to be the return of an object that has a track already, and takes its identity.

    odds = r e^(-T / lifetime) (moving + stationary) / density,   density = (new tracks of the class or group) / area
    moving     = (1 - s) (1 - s') / (1 - p)  N(m' - m; 0, P + P') / N(0; 0, V)          over position and velocity
    stationary = s s' / p  N(a' - a; 0, D + D')                                          over position

A return that begins with a weak detection, or far from where it was expected, initiates a track
(`saga_fg.tracking.relinking`). With each further detection of the new track the question is asked again, with all its
detections: what they say about the object is its filtered state (' above) divided by its prior. That is a velocity of
covariance V, a probability p to be stationary, and a position anywhere in the area. Of the velocity's prior its peak
counts, so that no odd velocity speaks for a re-link. The other symbols are those of `saga_fg.tracking.relinking`: r is
the existence of the old track at its latest detection, N(m, P) its state, s its probability to be stationary, N(a, D)
its place if it is.

The old track is then updated with the state of the new one, as with a measurement of position and velocity, and the
new one is marginalised. Only a track that has been detected up to `confirming_detections` times hands over, is
resolved (`saga_fg.tracking.unresolved`), and had its first detection after the latest one of the old track.

Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 8.4:
tests whether two tracks are of one object, and their fusion, errors taken for independent.
"""

from __future__ import annotations

import math

import numpy as np

from saga_fg.kernels.returns import return_evidence, returned_pairs
from saga_fg.model.interactions import POSITION, VELOCITY
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.assignment import Matching, least_total
from saga_fg.tracking.initiation import unmeasured_velocity
from saga_fg.tracking.relinking import area, least_log_odds, log_survival
from saga_fg.tracking.tracker_state import TrackerState

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
    """Pairs of rows (k,): new tracks just detected, and old ones of their class, or its group; the number (k,) of such
    new tracks."""
    table, settings = state.table, state.settings
    resolved, detected = table.unresolved == 0, np.zeros(len(table), dtype=bool)
    detected[matching.track] = settings.association.relink_above < 1
    detections = table.sensors.hits.sum(axis=1)
    new = (detected & resolved & (detections > 1) & (detections <= settings.confirming_detections)).nonzero()[0]
    if len(new) == 0:
        return new, new, new
    old = (~detected & resolved & (table.coasting(state.time) <= settings.max_coasting)).nonzero()[0]
    now, still = state.kinematics(), table.stationarity
    group, places = state.class_groups.numbers(table.label), (now.position, now.P, still.position, still.P)
    return returned_pairs(new, old, group, table.initiated, table.last_detected, *places, _FARTHEST)


def _log_evidence(state: TrackerState, new: IntArray, old: IntArray) -> tuple[FloatArray, FloatArray]:
    """(k,) logs of `moving` and `stationary`, see the module."""
    table, prior = state.table, state.settings.stationarity.prior
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
    table, joint, box, groups = state.table, state.joint, state.table.box, state.class_groups
    if state.settings.stationarity.prior > 0:
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
    if len(groups):
        table.class_belief[old] = groups.updated(table.class_belief[old], table.class_belief[new])
        table.label = groups.labels(table.class_belief, table.label)
    table.sensors.join(old, new)
    table.hits, table.opportunities = table.sensors.best_hits()
    for column in (table.score, table.covariance_scale, table.position_bias, table.last_detected, table.last_in_view):
        column[old] = column[new]
    table.best_score[old] = np.maximum(table.best_score[old], table.best_score[new])
    table.confirmed[old] |= table.confirmed[new]
    table.has_moved[old] |= table.has_moved[new]
    table.existence[old] = np.maximum(table.existence[old], table.existence[new])
    table.last_existence[old] = table.existence[old]

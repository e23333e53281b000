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

from saga_fg.estimators.protocol import LatestMarginals
from saga_fg.kernels.compilation import compiled_by
from saga_fg.kernels.returns import return_evidence, returned_pairs
from saga_fg.model.interactions import POSITION, VELOCITY
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.assignment import Matching, least_total, mahalanobis_of_pairs
from saga_fg.numerics.near_pairs import MOST_LOOPED, near_pairs
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
    return _returned(state, new, old)


def _returned_by_kernel(state: TrackerState, new: IntArray, old: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    now, still, table = state.kinematics(), state.table.stationarity, state.table
    group, places = state.class_groups.numbers(table.label), (now.position, now.P, still.position, still.P)
    return returned_pairs(new, old, group, table.initiated, table.last_detected, *places, _FARTHEST)


@compiled_by(_returned_by_kernel, where=lambda state, new, old: len(new) * len(old) <= MOST_LOOPED)
def _returned(state: TrackerState, new: IntArray, old: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """The candidates among `new` and `old` tracks."""
    table = state.table
    i, j = _near(state, new, old)
    alike = state.class_groups.pairs_of_group(table.label[new], table.label[old], i, j)
    chosen = alike & (table.last_detected[old[j]] < table.initiated[new[i]])
    i, j = i[chosen], j[chosen]
    return new[i], old[j], state.class_groups.number_of_group(table.label[new])[i]


def _near(state: TrackerState, new: IntArray, old: IntArray) -> tuple[IntArray, IntArray]:
    """Pairs (k,) of `new` and `old` near enough, moving or stationary, for their densities to count at all."""
    if len(old) == 0:
        return old, old
    now, still, found = state.kinematics(), state.table.stationarity, []
    for position, P in ((now.position, now.P), (still.position, still.P)):
        spread = P[:, 0, 0] + P[:, 1, 1]
        reach = np.sqrt(_FARTHEST * (spread[new] + spread[old].max()))  # no direction's variance exceeds the trace
        i, j = near_pairs(position[new], position[old], reach)
        d2, _ = mahalanobis_of_pairs(position[new[i]] - position[old[j]], P[new[i]] + P[old[j]])
        found.append((i * len(old) + j)[d2 < _FARTHEST])
    i, j = np.divmod(np.unique(np.concatenate(found)), len(old))
    return i, j


def _log_evidence(state: TrackerState, new: IntArray, old: IntArray) -> tuple[FloatArray, FloatArray]:
    """(k,) logs of `moving` and `stationary`, see the module."""
    table, prior = state.table, state.settings.stationarity.prior
    first = np.ones(len(new), dtype=bool)
    first[1:] = new[1:] != new[:-1]  # a new track is in many pairs, one after the other
    each, of_pair = new[first], first.cumsum() - 1
    place = state.kinematics().position[each] + state.origin
    _, V_0, p = unmeasured_velocity(state, table.label[each], place, table.box.yaw[each], prior)
    return _evidence(state, new, old, V_0[of_pair], p[of_pair])


def _evidence_by_kernel(
    state: TrackerState, new: IntArray, old: IntArray, V_0: FloatArray, p: FloatArray
) -> tuple[FloatArray, FloatArray]:
    estimator, table, still = state.joint.estimator, state.table, state.table.stationarity
    places, place, D, s = state.joint.places(table.label), still.position, still.P, still.probability
    (x, P), (x_old, P_old) = (estimator.planar_marginals(table.id[k], places[k]) for k in (new, old))
    if_still = s[new], s[old], place[new] - place[old], D[new] + D[old]
    return return_evidence(x, P, x_old, P_old, places[new, 2] >= 0, V_0, p, *if_still)


@compiled_by(
    _evidence_by_kernel, where=lambda state, new, old, V_0, p: isinstance(state.joint.estimator, LatestMarginals)
)
def _evidence(
    state: TrackerState, new: IntArray, old: IntArray, V_0: FloatArray, p: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """`_log_evidence` of velocities V_0 (k, 2, 2) that nobody has measured, and prior probabilities p (k,)."""
    table, stationarity, p = state.table, state.table.stationarity, np.clip(p, 1e-9, 1 - 1e-9)
    s, s_new = (np.clip(stationarity.probability[rows], 0.0, 1 - 1e-9) for rows in (old, new))
    moving = np.log1p(-s) + np.log1p(-s_new) - np.log1p(-p)
    for node_type, rows in state.joint.rows_by_type(table.label[new]):
        at = node_type.index(POSITION + VELOCITY if node_type.has(VELOCITY) else POSITION)
        mean, P = _marginals(state, np.concatenate([old[rows], new[rows]]), at)
        k = len(rows)
        moving[rows] += _log_density(mean[k:] - mean[:k], P[k:] + P[:k])
        if node_type.has(VELOCITY):
            moving[rows] -= _log_density(np.zeros((len(rows), 2)), V_0[rows])
    apart = stationarity.position[new] - stationarity.position[old]
    still = _log_density(apart, stationarity.P[old] + stationarity.P[new])
    with np.errstate(divide="ignore"):
        return moving, np.asarray(np.log(s) + np.log(s_new) - np.log(p) + still)


def _marginals(state: TrackerState, rows: IntArray, at: IntArray) -> tuple[FloatArray, FloatArray]:
    """Means (k, d) and covariances (k, d, d) of the components `at` (d,) of tracks `rows` (k,), which may repeat."""
    each, of_row = np.unique(rows, return_inverse=True)
    estimator, ids = state.joint.estimator, state.table.id[each]
    return estimator.mean(ids)[:, at][of_row], estimator.covariance(ids)[:, at[:, None], at][of_row]


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


def _log_density(x: FloatArray, S: FloatArray) -> FloatArray:
    """(k,) log N(x; 0, S) in 2 or 4 dimensions: that of the first two, and of the others given these."""
    d2, log_det = mahalanobis_of_pairs(x[:, :2], S[:, :2, :2])
    if x.shape[1] > 2:
        gain = np.swapaxes(np.linalg.solve(S[:, :2, :2], S[:, :2, 2:]), 1, 2)
        given = mahalanobis_of_pairs(x[:, 2:] - (gain @ x[:, :2, None])[:, :, 0], S[:, 2:, 2:] - gain @ S[:, :2, 2:])
        d2, log_det = d2 + given[0], log_det + given[1]
    return np.asarray(-0.5 * (d2 + log_det + x.shape[1] * math.log(2 * math.pi)))

r"""Re-link: a detection that would initiate a track may be the return of an object that has a track already.

    odds_ij = r_i e^(-T_i / lifetime) ( (1 - s_i) N(z_j; m_i, P_i + R_j) + s_i N(z_j; a_i, D_i + R_j) ) / density
    density = (number of detections of the class, or its group, that would initiate tracks) / area

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
"""

from __future__ import annotations

import math

import numpy as np

from saga_fg.kernels.compilation import compiled_by
from saga_fg.kernels.pairs import relinking_pairs
from saga_fg.kernels.track_limits import log_peaks
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, StrArray
from saga_fg.numerics.assignment import Matching, least_total, mahalanobis_of_pairs
from saga_fg.numerics.near_pairs import MOST_LOOPED, near_pairs
from saga_fg.tracking.measurements import FrameMeasurements
from saga_fg.tracking.stationarity import log_density
from saga_fg.tracking.tracker_state import TrackerState

_ROUNDING = 1 + 1e-6
_LEAST = 1e-300  # determinant that rounding leaves
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


def _pairs_by_kernel(
    state: TrackerState,
    tracks: IntArray,
    position: FloatArray,
    P: FloatArray,
    label: StrArray,
    z: FloatArray,
    R: FloatArray,
) -> tuple[IntArray, IntArray, FloatArray]:
    still, number = state.table.stationarity, state.class_groups.numbers
    group, of_place = number(state.table.label), number(label)
    log_density = np.log(np.bincount(of_place)[of_place] / area(state))
    objects = position, P, still.position, still.P, still.probability, log_survival(state)
    return relinking_pairs(tracks, group, *objects, z, R, of_place, log_density, least_log_odds(state), _ROUNDING)


@compiled_by(
    _pairs_by_kernel,
    where=lambda state, tracks, position, P, label, z, R: len(tracks) * len(z) <= MOST_LOOPED,
)
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
    i, j = _within_reach(state, tracks, position, P, z, R)
    alike = state.class_groups.pairs_of_group(state.table.label[tracks], label, i, j)
    t, j = tracks[i[alike]], j[alike]
    still, others = state.table.stationarity, state.class_groups.number_of_group(label)[j]
    moving = _log_density(z[j] - position[t], P[t] + R[j])
    standing = _log_density(z[j] - still.position[t], still.P[t] + R[j])
    s = np.clip(still.probability[t], 0.0, 1 - 1e-9)
    log_odds = log_survival(state)[t] + _mixed(s, moving, standing) - np.log(others / area(state))
    cost = least_log_odds(state) - log_odds
    paying = (cost < 0).nonzero()[0]
    return t[paying], j[paying], cost[paying]


def _within_reach(
    state: TrackerState, tracks: IntArray, position: FloatArray, P: FloatArray, z: FloatArray, R: FloatArray
) -> tuple[IntArray, IntArray]:
    """Pairs (K,) of `tracks` (n,), by `position` and P of all, and places z (m, 2) of noise R that could be re-linked.

    Neither density exceeds that of a distance beyond sqrt(trace(P + R)), at a peak of covariance P.
    """
    table, spread, found = state.table.stationarity, R[:, 0, 0] + R[:, 1, 1], []
    most = log_survival(state)[tracks] + math.log(area(state) / (2 * math.pi)) - least_log_odds(state)
    for mean, covariance in ((position, P), (table.position, table.P)):
        mean, covariance = mean[tracks], covariance[tracks]
        a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
        gate = np.maximum(2 * most - np.log(np.maximum(a * c - b * b, _LEAST)), 0.0) * _ROUNDING
        i, j = near_pairs(mean, z, np.sqrt(gate * (a + c + spread.max())))
        near = ((z[j] - mean[i]) ** 2).sum(axis=1) <= gate[i] * ((a + c)[i] + spread[j])
        found.append(i[near] * len(z) + j[near])
    i, j = np.divmod(np.unique(np.concatenate(found)), len(z))
    return i, j


def relinkable(state: TrackerState) -> BoolArray:
    """(n,) tracks with which a detection at their predicted place, and no other in the area, would be re-linked."""
    association, table = state.settings.association, state.table
    if association.relink_above == 1 or len(table) == 0:
        return np.zeros(len(table), dtype=bool)
    still = table.stationarity
    peaks = _log_peaks(state.kinematics().P, still.P, still.probability, log_survival(state))
    within = table.coasting(state.time) <= state.settings.max_coasting
    return np.asarray(within & (peaks >= least_log_odds(state) - math.log(area(state))))


@compiled_by(log_peaks)
def _log_peaks(P: FloatArray, D: FloatArray, stationary: FloatArray, log_survival: FloatArray) -> FloatArray:
    none, s = np.zeros((len(P), 2)), np.clip(stationary, 0.0, 1 - 1e-9)
    return np.asarray(log_survival + _mixed(s, _log_density(none, P), _log_density(none, D)))


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
    table, lifetime = state.table, state.settings.existence.lifetime
    real = np.maximum(table.last_existence, 1e-3)
    return np.asarray(np.log(real) - table.coasting(state.time) / lifetime)


def _mixed(s: FloatArray, moving: FloatArray, still: FloatArray) -> FloatArray:
    """(k,) log densities of tracks from those of moving and, with probability s (k,), of stationary objects (k,)."""
    return np.asarray(np.logaddexp(np.log1p(-s) + moving, np.log(np.maximum(s, 1e-300)) + still))


def _log_density(innovation: FloatArray, S: FloatArray) -> FloatArray:
    """(k,) log N(innovation; 0, S) in the plane, 1/m^2."""
    return log_density(innovation, S) - math.log(2 * math.pi)

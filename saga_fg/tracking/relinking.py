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

from saga_fg.kernels.pairs import relinking_pairs
from saga_fg.kernels.track_limits import log_peaks
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, StrArray
from saga_fg.numerics.assignment import Matching, least_total, mahalanobis_of_pairs
from saga_fg.tracking.measurements import FrameMeasurements
from saga_fg.tracking.tracker_state import TrackerState

_ROUNDING = 1 + 1e-6
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
    still, number = state.table.stationarity, state.class_groups.numbers
    group, of_place = number(state.table.label), number(label)
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
    table, lifetime = state.table, state.settings.existence.lifetime
    real = np.maximum(table.last_existence, 1e-3)
    return np.asarray(np.log(real) - table.coasting(state.time) / lifetime)

r"""Associate: match the measurements of a frame to the tracks, within the classes.

    cost_ij      = d_ij^2 + log det S_ij
    unmatched_ij = a 2 log( p_i / (1 - p_i) ) + b 2 log( p_j / (1 - p_j) ) - 2 log( 2 pi lambda )
    lambda       = sum over j of (1 - p_j) / clutter_area

A pair is matched for less than what it costs to leave both alone: with a = b = 1 the difference of the two is
-2 log of the ratio of likelihoods that the detection is the track's, or that the track was missed and the detection is
false. p_i = r_i v_i p_D: the track's existence, its visibility (`saga_fg.tracking.update`) and the sensor's
detection probability. p_j is the detection's probability; a and b below 1 reduce their influence. lambda is the number
of false detections of the class per m^2 that the frame's own scores suggest, so that it fits any detector. A track of
low existence, or one that nobody can see, can't take a strong detection from afar, least of all among many weak ones,
and of two detections the more probable one is preferred.

Candidates are the pairs of one class, or of classes that a sensor confuses, with a cost of their own
(`saga_fg.tracking.class_belief`), inside its gate. Identities that a sensor gives add theirs
(`saga_fg.tracking.identities`). The assignment is the one of least total cost (`hungarian`), is made
cheapest pair first (`greedy`), or registers the observed graph to the predicted graph (`graph`): the costs above
are then joined by those of `saga_fg.numerics.assignment` between pairs of candidates, of all classes, whose tracks
have correlated errors.

Beside it stand the probabilities p_ij of the pairs over all joint events, each of which weighs as the likelihood that
goes with these costs, and of a detection the share that is its track's, among the tracks that claim it:

    share_ij = p_ij / ( p_ij + sum of q_k p_kj over other tracks k )     q_k: r_k v_k of a confirmed track, else 0

It is 1 almost everywhere, and is taken as 1 from `association.clear_above` on. Below that the update is weighted by it
(`saga_fg.tracking.update`), and the two tracks may have exchanged their objects (`saga_fg.tracking.identities`).

Costs of a user's own (`AssociationCost`) are added to those of the pairs.

Sources: Blackman and Popoli, Design and Analysis of Modern Tracking Systems, 1999, section 6.2; Williams and Lau, IEEE
Transactions on Aerospace and Electronic Systems 50(4), 2014: marginals by belief propagation.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from saga_fg.errors import InputError
from saga_fg.kernels.pairs import gated_pairs
from saga_fg.kernels.tracks import association_marginals
from saga_fg.numerics import (
    BoolArray,
    Columns,
    CrossCovariances,
    FloatArray,
    IntArray,
    Matching,
    QuadraticMatching,
    cheapest_first,
    common_numbers,
    gate,
    least_total,
    near_pairs,
    pair_costs,
)
from saga_fg.parts import of_own_code, part_name
from saga_fg.tracking.class_belief import NONE_CONFUSED, ConfusedClasses
from saga_fg.tracking.identities import identity_cost
from saga_fg.tracking.measurements import FrameMeasurements, relative_covariances
from saga_fg.tracking.relinking import relinked
from saga_fg.tracking.settings import AssociationProblem, AssociationSettings, ClassSettings, TrackerSettings
from saga_fg.tracking.track_life import over_confirmed
from saga_fg.tracking.tracker_state import TrackerState
from saga_fg.types import Boxes, class_values

EXISTENCE_WEIGHT, SCORE_WEIGHT = 0.3, 0.5  # a and b above
MIN_CLUTTER = 0.05  # least expected number of false detections of a class in a frame
LARGEST_EXACT, SWEEPS = 8, 100  # tracks or detections of a cluster whose joint events are summed; sweeps beyond
_SURE = 20.0  # log weight of a pair of which both sides are hardly ever apart


@dataclass(frozen=True, eq=False)
class CandidatePairs(Columns):
    """K pairs that may be matched.

    track, detection  (K,) rows
    innovation, S     (K, 2), m, and its covariance (K, 2, 2)
    d2                (K,) its squared distance
    gain              (K,) cost of the pair less that of leaving both unmatched; negative if the match pays
    """

    track: IntArray
    detection: IntArray
    innovation: FloatArray
    S: FloatArray
    d2: FloatArray
    gain: FloatArray


def associate(state: TrackerState, measurements: FrameMeasurements) -> tuple[Matching, IntArray]:
    """Match the measurements to the tracks, predicted to the time of the frame; and rows (e, 2) of rivals, tracks of
    which one may have taken the detection of the other."""
    table, association = state.table, state.settings.association
    if len(table) == 0 or len(measurements) == 0:
        return Matching.empty(), np.empty((0, 2), dtype=np.int64)
    sensor, delay, cross = measurements.sensor, measurements.delay, None
    position, P = state.past_positions(delay)
    if association.method == "graph":
        cross = state.past_cross_covariances(delay)
    if measurements.relative is not None:
        P = relative_covariances(state.joint, table.id, table.label)
    last = state.identities.tracks(measurements.name, measurements.identity)
    predicted = state.boxes(position, np.full_like(position, np.nan))
    seen = table.existence * table.sensors.seen_by(measurements.name)
    expected = seen * sensor.detection_chance(table.label)
    area = association.clutter_area if sensor.clutter_area is None else sensor.clutter_area
    deferred = over_confirmed(state, predicted)
    real = np.where(table.confirmed, seen, 0.0)
    belief = state.class_belief()
    tracks = ExpectedTracks(predicted, P, expected, real, cross, deferred, state.confused, belief, table.id)
    if state.costs:
        tracks = tracks._replace(own_cost=_own_cost(state, measurements, predicted))
    found, rivals = match(tracks, measurements, state.settings, area, last)
    return relinked(state, measurements, found, position, P, tracks.own_cost), rivals


def _own_cost(state: TrackerState, measurements: FrameMeasurements, predicted: Boxes) -> FloatArray:
    """(n, m) sum of the costs of a user's own. Raises `InputError` for one of another shape, NaN or -infinity."""
    time = state.start + state.time - measurements.delay
    problem = AssociationProblem(
        measurements.name, time, state.table.id, predicted, measurements.row, measurements.boxes
    )
    total = np.zeros((len(predicted), len(measurements)))
    for k, cost in enumerate(state.costs):
        where = f"association.costs[{k}] ({part_name(cost)})"
        with of_own_code(where):
            given = np.asarray(cost(problem), dtype=np.float64)
        if given.shape != total.shape or not (given > -math.inf).all():
            what = f"shape {given.shape}" if given.shape != total.shape else "NaN or -infinity"
            raise InputError(f"{where}: expected numbers of shape {total.shape}, got {what}")
        total += given
    return total


class ExpectedTracks(NamedTuple):
    """The n tracks as a sensor should see them at the time of a frame.

    boxes     predicted, world
    P         (n, 2, 2) covariance of their positions
    chance    (n,) that the track is detected: its existence times its visibility and the detection probability
    real      (n,) of confirmed tracks, existence times visibility; 0 of others
    cross     covariances between the positions of tracks, for the method `graph`
    deferred  (n,) tracks that are matched to what the others leave; None: none
    confused  classes that sensors confuse, and the log-beliefs (n, C) in them
    id        (n,) of the tracks; needed where detections have identities
    own_cost  (n, m) of a user's own, added to that of the distance; None: none
    """

    boxes: Boxes
    P: FloatArray
    chance: FloatArray
    real: FloatArray
    cross: CrossCovariances | None = None
    deferred: BoolArray | None = None
    confused: ConfusedClasses = NONE_CONFUSED
    class_belief: FloatArray | None = None
    id: IntArray | None = None
    own_cost: FloatArray | None = None


def match(
    tracks: ExpectedTracks,
    measurements: FrameMeasurements,
    settings: TrackerSettings,
    clutter_area: float,
    last: IntArray | None = None,
) -> tuple[Matching, IntArray]:
    """The assignment of a frame, and its rivals, see `associate`.

    clutter_area  over which false detections spread, m^2
    last          (m,) the track that last had the identity of each detection, -1 for none
    """
    found = _candidates(tracks, measurements, settings, clutter_area)
    if last is not None and tracks.id is not None and (last >= 0).any():
        found = replace(found, gain=found.gain + identity_cost(found.track, found.detection, tracks.id, last))
    late = np.zeros(len(found.track), dtype=bool) if tracks.deferred is None else tracks.deferred[found.track]
    first = found if not late.any() else found.select(np.flatnonzero(~late))
    chosen = _chosen(first, settings.association, tracks.cross)
    p, share = _shares(first, tracks.real)
    clear = settings.association.clear_above
    matching = _matching(first, chosen, np.where(share < clear, share, 1.0))
    rivals = _rivals(first, matching, p > 1 - clear)
    if late.any():
        left = found.select(np.flatnonzero(late & ~np.isin(found.detection, matching.detection)))
        chosen = _chosen(left, settings.association, tracks.cross)
        matching = matching.append(_matching(left, chosen, np.ones(len(left.track))))
    return matching, rivals


def _chosen(found: CandidatePairs, association: AssociationSettings, cross: CrossCovariances | None) -> IntArray:
    """The pairs of least cost, each track and detection in one at most."""
    if association.method == "graph" and cross is not None:
        pairs = pair_costs(found.track, found.detection, found.innovation, found.S, cross)
        return QuadraticMatching(found.track, found.detection, found.gain, pairs).solve()
    choose = cheapest_first if association.method == "greedy" else least_total
    return choose(found.track, found.detection, found.gain)


def _matching(found: CandidatePairs, chosen: IntArray, share: FloatArray) -> Matching:
    return Matching(found.track[chosen], found.detection[chosen], found.d2[chosen], share[chosen])


def _shares(found: CandidatePairs, real: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(K,) probabilities of the pairs, and the share of its detection that is the track's."""
    if (np.bincount(found.detection) < 2).all():  # nobody has a rival, and no probability is asked for
        return np.ones(len(found.gain)), np.ones(len(found.gain))
    log_weight = -found.gain / 2 - max(-found.gain.max() / 2 - _SURE, 0.0)  # without clutter no pair is apart
    p = association_marginals(found.track, found.detection, log_weight, LARGEST_EXACT, SWEEPS)
    claim = real[found.track] * p
    of_others = np.bincount(found.detection, claim)[found.detection] - claim
    return p, p / np.maximum(p + of_others, 1e-9)


def _rivals(found: CandidatePairs, matching: Matching, possible: BoolArray) -> IntArray:
    """(e, 2) rows of two tracks, of which one has a detection that may be the other's by a possible pair (K,)."""
    owner = np.full(int(found.detection.max(initial=-1)) + 1, -1)
    owner[matching.detection] = matching.track
    other = owner[found.detection]
    doubtful = possible & (other >= 0) & (other != found.track)
    pairs = {
        (min(pair), max(pair)) for pair in zip(found.track[doubtful].tolist(), other[doubtful].tolist(), strict=True)
    }
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)


def _candidates(
    tracks: ExpectedTracks, measurements: FrameMeasurements, settings: TrackerSettings, clutter_area: float
) -> CandidatePairs:
    """The pairs of one class, or group, that are inside its gate; the arguments are those of `match`."""
    boxes, detected, confused = tracks.boxes, measurements.boxes, tracks.confused
    of_track, of_detection = confused.numbers(boxes.label, detected.label)
    reach, share = class_values(settings.classes, ClassSettings, boxes.label, "max_distance", "gate")
    x, z = boxes.position[:, :2], detected.position[:, :2]
    row, column = near_pairs(x, z, reach)
    pairs = gated_pairs(
        row=row,
        column=column,
        position=x,
        P=tracks.P,
        gate=np.array([gate(each) for each in share.tolist()]),
        group=of_track,
        z=z,
        R=measurements.R,
        group_z=of_detection,
    )
    found = CandidatePairs(*pairs)
    if tracks.own_cost is not None:
        found = replace(found, gain=found.gain + tracks.own_cost[found.track, found.detection])
        found = found.select(np.flatnonzero(found.gain < math.inf))
    if tracks.class_belief is not None and len(confused):
        reported = measurements.class_likelihood[found.detection]
        found = replace(found, gain=found.gain - 2 * confused.log_evidence(tracks.class_belief[found.track], reported))
        (of_detection,) = common_numbers(detected.label)
    unmatched = _unmatched(found, tracks.chance, measurements.probability, of_detection, clutter_area)
    return replace(found, gain=found.gain - unmatched)


def _unmatched(
    found: CandidatePairs,
    expected: FloatArray,
    probability: FloatArray,
    of_detection: IntArray,
    clutter_area: float,
) -> FloatArray:
    """(K,) cost of leaving pairs unmatched; for an infinite area so large that as many as possible are matched.

    found.gain (K,): costs of the pairs; of_detection (m,): the number of each detection's class
    """
    if clutter_area == math.inf:
        dearest = found.gain.max(initial=0.0)
        return np.full(len(found.gain), dearest + 1 + len(found.gain) * (dearest - found.gain.min(initial=dearest)))
    false = np.maximum(np.bincount(of_detection, weights=1 - probability), MIN_CLUTTER)
    of_track, by_score = EXISTENCE_WEIGHT * _log_odds(expected), SCORE_WEIGHT * _log_odds(probability)
    by_density = np.log(2 * math.pi * false / clutter_area)[of_detection]
    return np.asarray(2 * (of_track[found.track] + (by_score - by_density)[found.detection]))


def _log_odds(probability: FloatArray) -> FloatArray:
    p = np.clip(probability, 1e-6, 1 - 1e-6)
    return np.log(p / (1 - p))

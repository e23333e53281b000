r"""Data association over a whole recording: detections to objects, frame by frame, and tracklets to objects.

Detections are assigned at least total cost to given states, online or smoothed, by the squared distance

    d^2 = (z - m)^T (P + R)^-1 (z - m)

A tracker has no track yet where an object first shows itself by weak detections, and none any more after an occlusion.
A smoother reaches there from the object's later and earlier states: free detections are assigned to the objects that
have none in that frame.

Tracklets are stitched: an end i and a later beginning j, extended towards each other by the smoother, meet at the
moment j begins with the difference d of their states. That they are one object rather than that i left unseen and j is
new costs

    1/2 d^T S^-1 d + 1/2 log |2 pi S| + miss_cost * frames + log(new_object_density) - 1/2 log |2 pi V|,   S = P_i + P_j

nats, with V the covariance of the velocity of a new object and `frames` the frames in the gap that should have shown
it; pairs are stitched where that is negative in total. Objects are chains of tracklets that do not overlap, so that the
cheapest set of chains is a bipartite assignment (minimum-cost path cover; Zhang, Li and Nevatia, CVPR 2008, with the
tracklet in place of the detection). Only pairs within the gate are candidates, found by distance, moment by moment.
"""

from __future__ import annotations

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray
from saga_fg.numerics.assignment import gate, least_total, mahalanobis_of_pairs
from saga_fg.numerics.near_pairs import near_pairs
from saga_fg.smoothing.evidence import Evidence
from saga_fg.smoothing.settings import StitchingSettings
from saga_fg.smoothing.states import Lifespans, StateTable

NEW_OBJECT_DENSITY = 0.005  # density of objects that appear anew, 1/m^2
MISS_COST = 0.3  # cost of a frame in the gap that should have shown the object, nats
GATE = 0.999  # share of true links inside the chi-square gate


def assign_detections(
    label: StrArray,
    position: FloatArray,
    covariance: FloatArray,
    evidence: Evidence,
    rows: IntArray,
    share: float,
    max_distance: FloatArray,
) -> tuple[IntArray, IntArray]:
    """Rows of objects and of the evidence that belong together at one moment.

    label (n,), position (n, 2), covariance (n, 2, 2), max_distance (n,) of objects; rows (m,) of the evidence; share:
    of true pairs that the chi-square gate lets through
    """
    objects, detections = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int64)]
    for name in np.unique(label):
        a, b = np.flatnonzero(label == name), rows[evidence.boxes.label[rows] == name]
        if len(b) == 0:
            continue
        z = evidence.boxes.position[b, :2]
        row, column = near_pairs(position[a], z, max_distance[a])
        innovation = z[column] - position[a][row]
        d2, log_det = mahalanobis_of_pairs(innovation, covariance[a][row] + evidence.R[b, :2, :2][column])
        limit = gate(share)
        possible = (d2 < limit) & (np.hypot(*innovation.T) < max_distance[a][row])
        row, column, cost, log_det = row[possible], column[possible], (d2 + log_det)[possible], log_det[possible]
        chosen = least_total(row, column, cost - limit - log_det.max(initial=0.0))
        objects.append(a[row[chosen]])
        detections.append(b[column[chosen]])
    return np.concatenate(objects), np.concatenate(detections)


def assign_free_detections(
    evidence: Evidence,
    object_of: IntArray,
    lifespans: Lifespans,
    states: StateTable,
    share: float,
    max_distance: float,
) -> IntArray:
    """(N,) the object of each detection, once the free ones are assigned; none loses its object.

    share: of true pairs that the gate lets through; max_distance: between a state and a detection, m
    """
    result = object_of.copy()
    for frame, rows in zip(evidence.frames, evidence.rows_of_frame(), strict=True):
        free = rows.start + np.flatnonzero(result[rows] < 0)
        there = states.at(frame.moment)
        there = there.start + np.flatnonzero(~np.isin(states.id[there], result[rows]))
        if len(free) == 0 or len(there) == 0:
            continue
        ids, mean, P = states.id[there], states.mean[there, :2], states.covariance[there, :2, :2]
        label, reach = lifespans.label[lifespans.rows_of(ids)], np.full(len(ids), max_distance)
        objects, detections = assign_detections(label, mean, P, evidence, free, share, reach)
        result[detections] = ids[objects]
    return result


def stitch_tracklets(
    seen: Lifespans, states: StateTable, velocity_prior: FloatArray, evidence: Evidence, settings: StitchingSettings
) -> IntArray:
    """(n,) the object of each tracklet: the id of the first tracklet of its chain.

    seen: the tracklets, from first to last detection; states: theirs, reaching beyond both ends; velocity_prior
    (n, 2, 2): covariance of the velocity of a new object
    """
    limit = gate(GATE, 4)
    end, begin, a, b = _meetings(seen, states, evidence.times, settings.max_gap, limit)
    d = states.mean[a] - states.mean[b]
    S = states.covariance[a] + states.covariance[b]
    d2 = np.einsum("ni,ni->n", d, np.linalg.solve(S, d[..., None])[..., 0])
    inside = d2 <= limit
    end, begin, d2, S = end[inside], begin[inside], d2[inside], S[inside]
    cost = (d2 + _log_det(S)) / 2 + MISS_COST * _opportunities_between(evidence, seen, states, end, begin)
    cost -= _log_det(velocity_prior[begin]) / 2 - np.log(NEW_OBJECT_DENSITY)
    stitched = least_total(end, begin, cost)
    before = np.arange(len(seen))
    before[begin[stitched]] = end[stitched]
    for row in np.argsort(seen.first, kind="stable"):  # predecessors come earlier, so that they are settled
        before[row] = before[before[row]]
    return np.asarray(seen.id[before])


def _meetings(
    seen: Lifespans, states: StateTable, times: FloatArray, max_gap: float, limit: float
) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Pairs of tracklets of a class, one that ended at most `max_gap` s before the other begins, whose states may be
    inside the gate there: rows (p,) of both, and rows (p,) of their states at the later one's first moment.

    limit: of d^2, which is at least |d|^2 / tr S of the positions alone; the pairs are found by these
    """
    trace = np.trace(states.covariance[:, :2, :2], axis1=1, axis2=2)
    reach = np.sqrt(limit * trace) * (1 + 1e-9)  # |d| <= sqrt(limit (tr P_i + tr P_j)), which is at most their sum
    order = np.argsort(seen.first, kind="stable")
    moments, starts, counts = np.unique(seen.first[order], return_index=True, return_counts=True)
    found = [np.empty((4, 0), dtype=np.int64)]
    for moment, start, count in zip(moments.tolist(), starts.tolist(), counts.tolist(), strict=True):
        begin = order[start : start + count]
        there = states.at(moment)
        a = np.arange(there.start, there.stop)
        end = seen.rows_of(states.id[there])
        gap = times[moment] - times[seen.last[end]]
        ended = (gap > 0) & (gap <= max_gap)
        a, end = a[ended], end[ended]
        b = states.rows_of(np.full(len(begin), moment), seen.id[begin])
        begin, b = begin[b >= 0], b[b >= 0]
        i, j = near_pairs(states.mean[a, :2], states.mean[b, :2], reach[a], reach[b])
        alike = seen.label[end[i]] == seen.label[begin[j]]
        i, j = i[alike], j[alike]
        found.append(np.stack([end[i], begin[j], a[i], b[j]]))
    pairs = np.concatenate(found, axis=1)
    return pairs[0], pairs[1], pairs[2], pairs[3]


def _log_det(P: FloatArray) -> FloatArray:
    """log |2 pi P|"""
    return np.asarray(np.linalg.slogdet(2 * np.pi * P)[1])


def _opportunities_between(
    evidence: Evidence, seen: Lifespans, states: StateTable, end: IntArray, begin: IntArray
) -> FloatArray:
    """(p,) number of frames in the gap of each pair with the smoothed object in their field of view."""
    count = np.zeros(len(end))
    for frame in evidence.frames:
        within = np.flatnonzero((seen.last[end] < frame.moment) & (frame.moment < seen.first[begin]))
        at = states.rows_of(np.full(len(within), frame.moment), seen.id[end[within]])
        position = states.mean[np.maximum(at, 0), :2] + evidence.origin
        count[within] += frame.sensor.sees(position, frame.world_T_ego) & (at >= 0)
    return count

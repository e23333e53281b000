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
tracklet in place of the detection).
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray
from saga_fg.numerics.assignment import assign, gate, mahalanobis
from saga_fg.smoothing.evidence import Evidence
from saga_fg.smoothing.settings import StitchingSettings
from saga_fg.smoothing.states import Lifespans, StateTable


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
        d2, log_det = mahalanobis(position[a], covariance[a], z, evidence.R[b, :2, :2])
        apart = np.hypot(*np.moveaxis(z[None] - position[a][:, None], -1, 0))
        limit = gate(share)
        possible = (d2 < limit) & (apart < max_distance[a][:, None])
        row, column = assign(d2 + log_det, possible, limit + log_det.max(initial=0.0))
        objects.append(a[row])
        detections.append(b[column])
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
    times = evidence.times
    gap = times[seen.first][None, :] - times[seen.last][:, None]
    end, begin = np.nonzero((gap > 0) & (gap <= settings.max_gap) & (seen.label[:, None] == seen.label[None, :]))
    meeting = seen.first[begin]
    a, b = states.rows_of(meeting, seen.id[end]), states.rows_of(meeting, seen.id[begin])
    met = (a >= 0) & (b >= 0)
    end, begin, a, b = end[met], begin[met], a[met], b[met]
    d = states.mean[a] - states.mean[b]
    S = states.covariance[a] + states.covariance[b]
    d2 = np.einsum("ni,ni->n", d, np.linalg.solve(S, d[..., None])[..., 0])
    cost = (d2 + _log_det(S)) / 2 + settings.miss_cost * _opportunities_between(evidence, seen, states, end, begin)
    cost -= _log_det(velocity_prior[begin]) / 2 - np.log(settings.new_object_density)
    cost[d2 > gate(settings.gate, 4)] = np.inf
    gain = np.zeros((len(seen), len(seen)))
    gain[end, begin] = np.minimum(cost, 0.0)
    rows, columns = linear_sum_assignment(gain)
    stitched = gain[rows, columns] < 0
    before = np.arange(len(seen))
    before[columns[stitched]] = rows[stitched]
    for row in np.argsort(seen.first, kind="stable"):  # predecessors come earlier, so that they are settled
        before[row] = before[before[row]]
    return np.asarray(seen.id[before])


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

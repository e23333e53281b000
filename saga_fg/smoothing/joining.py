r"""Tracklets that are one object: the assignment of ends to beginnings of least total cost, over the whole recording.

An end i and a later beginning j, extended towards each other by the smoother, meet at the moment j begins with the
difference d of their states. That they are one object rather than that i left unseen and j is new costs

    1/2 d^T S^-1 d + 1/2 log |2 pi S| + miss_cost * looks + log(new_object_density) - 1/2 log |2 pi V|,  S = P_i + P_j

nats, with V the covariance of the velocity of something new and looks the frames in the gap that should have shown it;
pairs are joined where that is negative in total. Objects are chains of tracklets that do not overlap, so that the
cheapest set of chains is a bipartite assignment (minimum-cost path cover; Zhang, Li and Nevatia, CVPR 2008, with the
tracklet in place of the detection).
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.assignment import gate
from saga_fg.smoothing.evidence import Evidence
from saga_fg.smoothing.settings import StitchingSettings
from saga_fg.smoothing.states import Lives, StateTable


def join_tracklets(
    seen: Lives, states: StateTable, velocity_prior: FloatArray, evidence: Evidence, settings: StitchingSettings
) -> IntArray:
    """(n,) the object of each tracklet: the id of the first tracklet of its chain.

    seen: the tracklets, from first to last detection; states: theirs, reaching beyond both ends; velocity_prior
    (n, 2, 2): covariance of the velocity of something new
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
    cost = (d2 + _log_det(S)) / 2 + settings.miss_cost * _looks_between(evidence, seen, states, end, begin)
    cost -= _log_det(velocity_prior[begin]) / 2 - np.log(settings.new_object_density)
    cost[d2 > gate(settings.gate, 4)] = np.inf
    gain = np.zeros((len(seen), len(seen)))
    gain[end, begin] = np.minimum(cost, 0.0)
    rows, columns = linear_sum_assignment(gain)
    joined = gain[rows, columns] < 0
    before = np.arange(len(seen))
    before[columns[joined]] = rows[joined]
    for row in np.argsort(seen.first, kind="stable"):  # predecessors come earlier, so that they are settled
        before[row] = before[before[row]]
    return np.asarray(seen.id[before])


def _log_det(P: FloatArray) -> FloatArray:
    """log |2 pi P|"""
    return np.asarray(np.linalg.slogdet(2 * np.pi * P)[1])


def _looks_between(evidence: Evidence, seen: Lives, states: StateTable, end: IntArray, begin: IntArray) -> FloatArray:
    """(p,) how many frames in the gap of each pair had the object in view, where the smoother has it."""
    count = np.zeros(len(end))
    for look in evidence.looks:
        within = np.flatnonzero((seen.last[end] < look.moment) & (look.moment < seen.first[begin]))
        at = states.rows_of(np.full(len(within), look.moment), seen.id[end[within]])
        position = states.mean[np.maximum(at, 0), :2] + evidence.origin
        count[within] += look.sensor.sees(position, look.world_T_ego) & (at >= 0)
    return count

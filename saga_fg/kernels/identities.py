"""Probabilities of associations."""

from __future__ import annotations

import numpy as np

from saga_fg.kernels.compilation import FloatArray, IntArray, kernel, kernel_part
from saga_fg.kernels.components import root_of


@kernel_part
def _enumerated(row: IntArray, column: IntArray, weight: FloatArray, free: FloatArray, m: int) -> FloatArray:
    """Marginals (K,) of pairs over all joint events; free (n,) weights of rows left alone; m columns."""
    n, K, masks = len(free), len(row), 1 << m
    forward, backward, p = np.zeros((n + 1, masks)), np.ones((n + 1, masks)), np.zeros(K)
    forward[0, 0] = 1.0
    for i in range(n):
        forward[i + 1] = forward[i] * free[i]
        for k in range(K):
            for mask in range(masks if row[k] == i else 0):
                if not mask >> column[k] & 1:
                    forward[i + 1, mask | 1 << column[k]] += forward[i, mask] * weight[k]
        forward[i + 1] /= forward[i + 1].sum()
    for i in range(n - 1, -1, -1):
        backward[i] = backward[i + 1] * free[i]
        for k in range(K):
            for mask in range(masks if row[k] == i else 0):
                if not mask >> column[k] & 1:
                    term = weight[k] * backward[i + 1, mask | 1 << column[k]]
                    backward[i, mask] += term
                    p[k] += forward[i, mask] * term
        total = (forward[i] * backward[i]).sum()
        for k in range(K):
            if row[k] == i:
                p[k] /= total
        backward[i] /= backward[i].max()
    return p


@kernel_part
def _propagated(
    row: IntArray, column: IntArray, weight: FloatArray, free: FloatArray, m: int, sweeps: int
) -> FloatArray:
    """Marginals (K,) of pairs by loopy belief propagation; free (n,) weights of leaving rows alone; m columns."""
    K, change = len(row), 1.0
    nu, mu = np.ones(K), np.empty(K)
    for sweep in range(sweeps + 1):
        total = free.copy()
        for k in range(K):
            total[row[k]] += weight[k] * nu[k]
        if sweep == sweeps or change < 1e-9:
            break
        back, change = np.ones(m), 0.0
        for k in range(K):
            mu[k] = weight[k] / max(total[row[k]] - weight[k] * nu[k], 1e-300)
            back[column[k]] += mu[k]
        for k in range(K):
            new = 1 / max(back[column[k]] - mu[k], 1e-300)
            change = max(change, abs(new - nu[k]))
            nu[k] = new
    for k in range(K):
        mu[k] = weight[k] * nu[k] / total[row[k]]
    return mu


@kernel("i1 i1 f1 i i")
def association_marginals(
    track: IntArray, detection: IntArray, log_weight: FloatArray, largest: int, sweeps: int
) -> FloatArray:
    """Probabilities (K,) of pairs of tracks and detections over all joint events, each in one pair at most.

    log_weight (K,): log of the weight of a pair, where a track and a detection apart have 1; the weight of an event is
    the product. Components with at most `largest` tracks or detections are exact, by a recursion over the other side
    that carries the set of those taken; the others by loopy belief propagation, at most `sweeps` sweeps.

    Source: Williams and Lau, Approximate evaluation of marginal association probabilities with belief propagation,
    IEEE Transactions on Aerospace and Electronic Systems 50(4), 2014.
    """
    K, n, m = len(track), 0, 0
    for k in range(K):
        n, m = max(n, track[k] + 1), max(m, detection[k] + 1)
    parent, component, result = np.arange(n + m), np.empty(K, dtype=np.int64), np.empty(K)
    for k in range(K):
        parent[root_of(parent, n + detection[k])] = root_of(parent, track[k])
    for k in range(K):
        component[k] = root_of(parent, track[k])
    order, number, at = np.argsort(component, kind="mergesort"), np.full(n + m, -1), 0
    while at < K:
        end, counts = at, [0, 0]
        while end < K and component[order[end]] == component[order[at]]:
            for side in range(2):
                node = track[order[end]] if side == 0 else n + detection[order[end]]
                if number[node] < 0:
                    number[node] = counts[side]
                    counts[side] += 1
            end += 1
        part = order[at:end]
        first, second, weight = number[track[part]], number[n + detection[part]], log_weight[part]
        if counts[1] > counts[0]:
            first, second = second, first
        most = np.zeros(max(counts))
        for e in range(len(part)):
            most[first[e]] = max(most[first[e]], weight[e])
        weight, free = np.exp(weight - most[first]), np.exp(-most)  # each row scaled, which changes no probability
        if min(counts) <= largest:
            result[part] = _enumerated(first, second, weight, free, min(counts))
        else:
            result[part] = _propagated(first, second, weight, free, min(counts), sweeps)
        at = end
    return result

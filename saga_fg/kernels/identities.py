"""Who is who: probabilities of associations, and tracks that may have exchanged their objects."""

from __future__ import annotations

import math

import numpy as np

from saga_fg.kernels.compilation import BoolArray, FloatArray, IntArray, kernel, kernel_part


@kernel_part
def _root(parent: IntArray, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@kernel_part
def _enumerated(row: IntArray, column: IntArray, weight: FloatArray, n: int, m: int) -> FloatArray:
    """Marginals (K,) of pairs in order of their rows, over all joint events; m columns, ten at most."""
    K, masks = len(row), 1 << m
    forward, backward = np.zeros((n + 1, masks)), np.zeros((n + 1, masks))
    free = np.zeros(n)  # of leaving the row alone, scaled as the weights of the row
    start = np.zeros(n + 1, dtype=np.int64)
    for k in range(K):
        start[row[k] + 1] = k + 1
    scaled = np.empty(K)
    for i in range(n):
        most = 0.0
        for k in range(start[i], start[i + 1]):
            most = max(most, weight[k])
        free[i] = math.exp(-most)
        for k in range(start[i], start[i + 1]):
            scaled[k] = math.exp(weight[k] - most)
    forward[0, 0] = 1.0
    for i in range(n):
        total = 0.0
        for mask in range(masks):
            f = forward[i, mask]
            if f > 0:
                forward[i + 1, mask] += f * free[i]
                for k in range(start[i], start[i + 1]):
                    if not mask >> column[k] & 1:
                        forward[i + 1, mask | 1 << column[k]] += f * scaled[k]
        for mask in range(masks):
            total += forward[i + 1, mask]
        for mask in range(masks):
            forward[i + 1, mask] /= total
    backward[n, :] = 1.0
    p = np.zeros(K)
    for i in range(n - 1, -1, -1):
        total = 0.0
        for mask in range(masks):
            b = backward[i + 1, mask] * free[i]
            total += forward[i, mask] * b
            for k in range(start[i], start[i + 1]):
                if not mask >> column[k] & 1:
                    term = scaled[k] * backward[i + 1, mask | 1 << column[k]]
                    b += term
                    p[k] += forward[i, mask] * term
                    total += forward[i, mask] * term
            backward[i, mask] = b
        for k in range(start[i], start[i + 1]):
            p[k] /= total
        most = 0.0
        for mask in range(masks):
            most = max(most, backward[i, mask])
        for mask in range(masks):
            backward[i, mask] /= most
    return p


@kernel_part
def _propagated(row: IntArray, column: IntArray, weight: FloatArray, n: int, m: int, sweeps: int) -> FloatArray:
    """Marginals (K,) of pairs by loopy belief propagation."""
    K = len(row)
    w, nu, mu = np.empty(K), np.ones(K), np.empty(K)
    free, total, back = np.zeros(n), np.empty(n), np.empty(m)
    for k in range(K):
        free[row[k]] = max(free[row[k]], weight[k])
    for k in range(K):
        w[k] = math.exp(weight[k] - free[row[k]])
    for i in range(n):
        free[i] = math.exp(-free[i])
    for _ in range(sweeps):
        total[:] = free
        for k in range(K):
            total[row[k]] += w[k] * nu[k]
        back[:] = 1.0
        for k in range(K):
            mu[k] = w[k] / max(total[row[k]] - w[k] * nu[k], 1e-300)
            back[column[k]] += mu[k]
        change = 0.0
        for k in range(K):
            new = 1 / max(back[column[k]] - mu[k], 1e-300)
            change = max(change, abs(new - nu[k]))
            nu[k] = new
        if change < 1e-9:
            break
    total[:] = free
    for k in range(K):
        total[row[k]] += w[k] * nu[k]
    p = np.empty(K)
    for k in range(K):
        p[k] = w[k] * nu[k] / total[row[k]]
    return p


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
    K = len(track)
    result = np.empty(K)
    n, m = 0, 0
    for k in range(K):
        n, m = max(n, track[k] + 1), max(m, detection[k] + 1)
    parent = np.arange(n + m)
    for k in range(K):
        a, b = _root(parent, track[k]), _root(parent, n + detection[k])
        if a != b:
            parent[b] = a
    component = np.empty(K, dtype=np.int64)
    for k in range(K):
        component[k] = _root(parent, track[k])
    order = np.argsort(component, kind="mergesort")
    number = np.full(n + m, -1)
    at = 0
    while at < K:
        end, rows, columns = at, 0, 0
        while end < K and component[order[end]] == component[order[at]]:
            k = order[end]
            if number[track[k]] < 0:
                number[track[k]] = rows
                rows += 1
            if number[n + detection[k]] < 0:
                number[n + detection[k]] = columns
                columns += 1
            end += 1
        part = order[at:end]
        flip = columns > rows
        size = end - at
        first, second, weight = np.empty(size, dtype=np.int64), np.empty(size, dtype=np.int64), np.empty(size)
        for e in range(size):
            i, j = number[track[part[e]]], number[n + detection[part[e]]]
            first[e], second[e] = (j, i) if flip else (i, j)
            weight[e] = log_weight[part[e]]
        if flip:
            rows, columns = columns, rows
        if columns <= largest:
            by_row = np.argsort(first, kind="mergesort")
            p = _enumerated(first[by_row], second[by_row], weight[by_row], rows, columns)
            for e in range(size):
                result[part[by_row[e]]] = p[e]
        else:
            p = _propagated(first, second, weight, rows, columns, sweeps)
            for e in range(size):
                result[part[e]] = p[e]
        at = end
    return result


@kernel("f3 f4 f1 f1 f3 f4 b2")
def exchanged_tracks(
    x: FloatArray, P: FloatArray, noise: FloatArray, dt: FloatArray, z: FloatArray, R: FloatArray, seen: BoolArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The evidence (E,) of a frame that pairs of tracks exchanged their objects, and the states after it.

    x (E, 4, 4), P (E, 4, 4, 4): position and velocity of the first and second, then of both exchanged; noise (E,) of
    the acceleration, m^2/s^3; dt (E,) s before; z (E, 2, 2), R (E, 2, 2, 2): detections of the two where `seen` (E, 2)
    """
    E = len(dt)
    X, C, evidence = x.copy(), P.copy(), np.zeros(E)
    A, K = np.empty((4, 4)), np.empty((4, 2))
    for e in range(E):
        t, q = dt[e], noise[e]
        for h in range(4):
            m, V = X[e, h], C[e, h]
            for i in range(2):
                m[i] += t * m[2 + i]
                for j in range(4):
                    V[i, j] += t * V[i + 2, j]
            for i in range(4):
                for j in range(2):
                    V[i, j] += t * V[i, j + 2]
            for i in range(2):
                V[i, i] += q * t**3 / 3
                V[i, i + 2] += q * t**2 / 2
                V[i + 2, i] += q * t**2 / 2
                V[i + 2, i + 2] += q * t
            d = h if h < 2 else 3 - h
            if not seen[e, d]:
                continue
            u, v = z[e, d, 0] - m[0], z[e, d, 1] - m[1]
            a, b, c = V[0, 0] + R[e, d, 0, 0], V[0, 1] + R[e, d, 0, 1], V[1, 1] + R[e, d, 1, 1]
            det = a * c - b * b
            log_density = -0.5 * ((c * u * u - 2 * b * u * v + a * v * v) / det + math.log(det))
            evidence[e] += log_density if h >= 2 else -log_density
            for i in range(4):
                K[i, 0], K[i, 1] = (V[i, 0] * c - V[i, 1] * b) / det, (V[i, 1] * a - V[i, 0] * b) / det
                m[i] += K[i, 0] * u + K[i, 1] * v
            for i in range(4):
                for j in range(4):
                    A[i, j] = V[i, j] - K[i, 0] * V[0, j] - K[i, 1] * V[1, j]
            for i in range(4):
                for j in range(4):
                    V[i, j] = (A[i, j] + A[j, i]) / 2
    return evidence, X, C

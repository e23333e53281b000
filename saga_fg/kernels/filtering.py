r"""Prediction and correction of a joint state that is split into components, see `saga_fg.kernels.components`.

    m <- F m + b     P <- F P F^T + Q
    S = H P H^T + R = L L^T     W = L^-1 H P     m <- m + W^T L^-1 (z - H m)     P <- P - W^T W

Blocks of F between parts of the components are inputs that are taken for independent: F_ij m_j, with the noise
F_ij P_jj F_ij^T. Measurements come one after the other.
"""

import math

import numpy as np

from saga_fg.kernels.compilation import FloatArray, IntArray, kernel, kernel_part

TILE = 16  # rows and columns that are turned at once: as much as the nearest cache holds


@kernel_part
def mirror(P: FloatArray) -> None:
    """Make a matrix (s, s) symmetric by what is below its diagonal, in place."""
    s = len(P)
    for tile in range(0, s, TILE):
        for other in range(0, tile + 1, TILE):
            for p in range(tile, min(tile + TILE, s)):
                for q in range(other, min(other + TILE, p)):
                    P[q, p] = P[p, q]


@kernel("f1 f1c i1 i1 i1 i1 i1 i1 i1 i1 i1 i1 f1 f1 i1 i1 f1")
def predicted_state(
    mean: FloatArray,
    flat: FloatArray,
    label: IntArray,
    start: IntArray,
    size: IntArray,
    offset: IntArray,
    dims: IntArray,
    offsets: IntArray,
    part: IntArray,
    target: IntArray,
    source: IntArray,
    at_F: IntArray,
    F: FloatArray,
    b: FloatArray,
    noisy: IntArray,
    at_Q: IntArray,
    Q: FloatArray,
) -> tuple[bool, FloatArray, FloatArray]:
    """Mean and blocks after an interval, and whether they are finite.

    part (n,): of the components; target, source (m,): nodes of the blocks of F, which begin at at_F (m,) in F; noisy
    (q,): nodes of the blocks of Q, which begin at at_Q (q,)
    """
    n, m = len(label), len(target)
    moved, result = b.copy(), np.zeros(len(flat))
    into, at = np.zeros(n + 1, dtype=np.int64), np.empty(m, dtype=np.int64)
    for e in range(m):
        into[target[e] + 1] += 1
    count, largest = 0, 0
    for i in range(n):
        into[i + 1] += into[i]
        count, largest = max(count, label[i] + 1), max(largest, size[i])
    used = into[:n].copy()
    for e in range(m):
        at[used[target[e]]] = e
        used[target[e]] += 1
    first, following = np.full(count, -1, dtype=np.int64), np.full(n, -1, dtype=np.int64)
    for i in range(n - 1, -1, -1):
        following[i], first[label[i]] = first[label[i]], i
    work, turned = np.empty(largest * largest), np.empty(largest * largest)
    for k in range(count):
        s, begin = size[first[k]], start[first[k]]
        P, product = flat[begin : begin + s * s].reshape(s, s), work[: s * s].reshape(s, s)
        F_P, after = turned[: s * s].reshape(s, s), result[begin : begin + s * s].reshape(s, s)
        for p in range(s * s):
            turned[p] = 0.0
        i = first[k]
        while i >= 0:
            for x in range(into[i], into[i + 1]):
                e = at[x]
                j = source[e]
                d = dims[j]
                for a in range(dims[i]):
                    row = offset[i] + a
                    for c in range(d):
                        f = F[at_F[e] + a * d + c]
                        if f != 0.0:
                            moved[offsets[i] + a] += f * mean[offsets[j] + c]
                            if part[j] == part[i]:
                                other = offset[j] + c
                                for q in range(s):
                                    F_P[row, q] += f * P[other, q]
            i = following[i]
        for tile in range(0, s, TILE):
            for other in range(0, s, TILE):
                for p in range(tile, min(tile + TILE, s)):
                    for q in range(other, min(other + TILE, s)):
                        product[p, q] = F_P[q, p]
        i = first[k]
        while i >= 0:  # F (F P)^T, below the diagonal
            for x in range(into[i], into[i + 1]):
                e = at[x]
                j = source[e]
                d = dims[j]
                if part[j] != part[i]:
                    continue
                for a in range(dims[i]):
                    row = offset[i] + a
                    for c in range(d):
                        f = F[at_F[e] + a * d + c]
                        if f != 0.0:
                            other = offset[j] + c
                            for q in range(row + 1):
                                after[row, q] += f * product[other, q]
            i = following[i]
        mirror(after)
    for e in range(m):  # inputs from other parts
        i, j = target[e], source[e]
        if part[i] != part[j]:
            d, s, t = dims[j], size[i], size[j]
            corner = start[i] + offset[i] * s + offset[i]
            own = start[j] + offset[j] * t + offset[j]
            for a in range(dims[i]):
                for c in range(d):
                    f = F[at_F[e] + a * d + c]
                    if f == 0.0:
                        continue
                    for a2 in range(dims[i]):
                        noise = 0.0
                        for c2 in range(d):
                            noise += flat[own + c * t + c2] * F[at_F[e] + a2 * d + c2]
                        result[corner + a * s + a2] += f * noise
    for e in range(len(noisy)):
        i = noisy[e]
        d, s = dims[i], size[i]
        corner = start[i] + offset[i] * s + offset[i]
        for a in range(d):
            for c in range(d):
                result[corner + a * s + c] += Q[at_Q[e] + a * d + c]
    finite = True
    for p in range(len(moved)):
        finite = finite and math.isfinite(moved[p])
    for p in range(len(result)):
        finite = finite and math.isfinite(result[p])
    return finite, moved, result


@kernel("f1 f1c i1 i1 i1 i1 i1 i1 i1 f2 f3 f3 f")
def corrected_state(
    mean: FloatArray,
    flat: FloatArray,
    start: IntArray,
    size: IntArray,
    offset: IntArray,
    offsets: IntArray,
    first: IntArray,
    places: IntArray,
    rows: IntArray,
    z: FloatArray,
    H: FloatArray,
    R: FloatArray,
    cancellation: float,
) -> tuple[bool, FloatArray, FloatArray, float]:
    """Mean and blocks given measurements z (m, k) of the nodes `rows` (m,), and the log-likelihood of innovations.

    Begins with whether all S are positive definite; otherwise the rest is void. first (n,), places (D,): where the
    states of a component are in the mean; cancellation: ratio of variances below which a correction is refined
    """
    result, moved = flat.copy(), mean.copy()  # of the blocks only what is below their diagonals, until the end
    m, k, d = H.shape
    largest = 0
    for r in range(m):
        largest = max(largest, size[rows[r]])
    W, K, D = np.empty((k, largest)), np.empty((k, largest)), np.empty((k, largest))
    L, w, before = np.empty((k, k)), np.empty(k), np.empty(largest)
    likelihood = -0.5 * m * k * math.log(2 * math.pi)
    for r in range(m):
        i = rows[r]
        s, begin = size[i], start[i]
        P = result[begin : begin + s * s].reshape(s, s)
        for a in range(k):  # H P and z - H m
            w[a] = z[r, a]
            for q in range(s):
                W[a, q] = 0.0
            for c in range(d):
                h = H[r, a, c]
                if h != 0.0:
                    w[a] -= h * moved[offsets[i] + c]
                    row = offset[i] + c
                    for q in range(row + 1):
                        W[a, q] += h * P[row, q]
                    for q in range(row + 1, s):
                        W[a, q] += h * P[q, row]
        for a in range(k):  # S = L L^T
            for c in range(a + 1):
                total = R[r, a, c]
                for e in range(d):
                    total += W[a, offset[i] + e] * H[r, c, e]
                for e in range(c):
                    total -= L[a, e] * L[c, e]
                if a > c:
                    L[a, c] = total / L[c, c]
                elif total > 0.0:
                    L[a, a] = math.sqrt(total)
                else:
                    return False, moved, result, 0.0
        for a in range(k):  # L^-1
            for c in range(a):
                f = L[a, c]
                w[a] -= f * w[c]
                for q in range(s):
                    W[a, q] -= f * W[c, q]
            w[a] /= L[a, a]
            likelihood -= 0.5 * w[a] * w[a] + math.log(L[a, a])
            for q in range(s):
                W[a, q] /= L[a, a]
        lost = False
        for p in range(s):
            before[p] = P[p, p]
        for p in range(s):
            for a in range(k):
                moved[places[first[i] + p]] += W[a, p] * w[a]
            for a in range(0, k - 1, 2):  # two rows at once take half as many passes over P
                f, g, b = W[a, p], W[a + 1, p], a + 1
                for q in range(p + 1):
                    P[p, q] -= f * W[a, q] + g * W[b, q]
            if k % 2:
                f, b = W[k - 1, p], k - 1
                for q in range(p + 1):
                    P[p, q] -= f * W[b, q]
            lost = lost or P[p, p] < cancellation * before[p]
        if lost:  # K^T = L^-T W;  P <- P + K (R K^T - H P)
            mirror(P)
            for a in range(k - 1, -1, -1):
                for q in range(s):
                    total = W[a, q]
                    for c in range(a + 1, k):
                        total -= L[c, a] * K[c, q]
                    K[a, q] = total / L[a, a]
            for a in range(k):
                for q in range(s):
                    total = 0.0
                    for c in range(k):
                        total += R[r, a, c] * K[c, q]
                    for c in range(d):
                        total -= H[r, a, c] * P[offset[i] + c, q]
                    D[a, q] = total
            for p in range(s):
                for a in range(k):
                    for q in range(s):
                        P[p, q] += K[a, p] * D[a, q]
            for p in range(s):
                for q in range(p):
                    middle = (P[p, q] + P[q, p]) / 2
                    P[p, q] = middle
                    P[q, p] = middle
    corrected = np.zeros(len(flat) + 1, dtype=np.bool_)  # by where their blocks begin
    for r in range(m):
        i = rows[r]
        if not corrected[start[i]]:
            corrected[start[i]] = True
            mirror(result[start[i] : start[i] + size[i] * size[i]].reshape(size[i], size[i]))
    return True, moved, result, likelihood


@kernel("f1 i1 i1 i1 i1 i1 i1 i1 i1 f1")
def tie_strengths(
    flat: FloatArray,
    start: IntArray,
    size: IntArray,
    offset: IntArray,
    dims: IntArray,
    part: IntArray,
    target: IntArray,
    source: IntArray,
    at_F: IntArray,
    F: FloatArray,
) -> FloatArray:
    """(m,) largest correlation that each block of F between two parts brings about, 0 within one.

    In deviations before the interval, see `saga_fg.estimators.filtering`; part (n,) of each node
    """
    strength = np.zeros(len(target))
    for e in range(len(target)):
        i, j = target[e], source[e]
        if part[i] == part[j]:
            continue
        s, t, d = size[i], size[j], dims[j]
        own = start[j] + offset[j] * t + offset[j]
        for a in range(dims[i]):
            p = offset[i] + a
            by_i = math.sqrt(flat[start[i] + s * p + p])
            for c in range(d):
                total = 0.0
                for x in range(d):
                    total += F[at_F[e] + a * d + x] * flat[own + x * t + c]
                by_j = math.sqrt(flat[own + c * t + c])
                strength[e] = max(strength[e], abs(total) / (by_i * by_j))
    return strength

r"""Exponentials of many small matrices and the integrals over them, see `saga_fg.model.discretisation`.

    phi_k(M dt),   Q = int_0^dt exp(M s) Qc exp(M^T s) ds,   int_0^dt exp(M (dt - s)) C exp(A s) ds

Matrices are mostly zeros, which their products leave out.
"""

from __future__ import annotations

import math

import numpy as np

from saga_fg.kernels.array_types import FloatArray, IntArray
from saga_fg.kernels.compilation import kernel


@kernel("f3 f3 f i i i f")
def phi_and_noise(
    M: FloatArray, Qc: FloatArray, dt: float, order: int, degree: int, noise_degree: int, radius: float
) -> tuple[FloatArray, FloatArray]:
    """phi_0 to phi_order (order + 1, m, d, d) and Q (m, d, d) of M and Qc (m, d, d).

    Taylor series of these degrees at M dt / 2^s, whose norm is at most `radius`, doubled s times
    """
    m, d = M.shape[0], M.shape[1]
    phis, noise = np.empty((order + 1, m, d, d)), np.empty((m, d, d))
    Z, product, term, turned = np.empty((d, d)), np.empty((d, d)), np.empty((d, d)), np.empty((d, d))
    Q = np.empty((d, d))
    phi, doubled = np.empty((order + 1, d, d)), np.empty((order + 1, d, d))
    for i in range(m):
        largest = 0.0
        for a in range(d):
            total = 0.0
            for b in range(d):
                total += abs(M[i, a, b])
            largest = max(largest, total)
        doublings = 0
        norm = largest * dt
        if norm > radius and norm < math.inf:
            doublings = math.ceil(math.log2(norm / radius))
        h = dt / 2.0**doublings
        for a in range(d):
            for b in range(d):
                Z[a, b] = M[i, a, b] * h
        inverse = 1.0  # 1 / (order + degree)!
        for j in range(2, order + degree + 1):
            inverse /= j
        for a in range(d):
            for b in range(d):
                phi[order, a, b] = inverse if a == b else 0.0
        for j in range(degree - 1, -order - 1, -1):  # phi_order by Horner's rule, then the lower ones
            k = order + min(j, 0)
            inverse *= order + j + 1
            above = min(k + 1, order) if j < 0 else order
            for a in range(d):
                for b in range(d):
                    product[a, b] = 0.0
                for c in range(d):
                    z = Z[a, c]
                    if z != 0.0:
                        for b in range(d):
                            product[a, b] += z * phi[above, c, b]
                product[a, a] += inverse
            for a in range(d):
                for b in range(d):
                    phi[k, a, b] = product[a, b]
        for a in range(d):
            for b in range(d):
                term[a, b] = Qc[i, a, b] * h
                Q[a, b] = term[a, b]
        for j in range(2, noise_degree + 1):
            for a in range(d):
                for b in range(d):
                    product[a, b] = 0.0
                for c in range(d):
                    z = Z[a, c]
                    if z != 0.0:
                        for b in range(d):
                            product[a, b] += z * term[c, b]
            for a in range(d):
                for b in range(d):
                    term[a, b] = (product[a, b] + product[b, a]) / j
                    Q[a, b] += term[a, b]
        for _ in range(doublings):
            for a in range(d):  # Q + phi_0 Q phi_0^T
                for b in range(d):
                    total = 0.0
                    for c in range(d):
                        total += phi[0, a, c] * Q[c, b]
                    turned[a, b] = total
            for a in range(d):
                for b in range(d):
                    total = 0.0
                    for c in range(d):
                        total += turned[a, c] * phi[0, b, c]
                    product[a, b] = Q[a, b] + total
            for a in range(d):
                for b in range(d):
                    Q[a, b] = product[a, b]
            for k in range(order + 1):
                for a in range(d):
                    for b in range(d):
                        total = 0.0
                        for c in range(d):
                            total += phi[0, a, c] * phi[k, c, b]
                        factor = 1.0
                        for j in range(k, 0, -1):  # phi_j / (k - j)!
                            total += phi[j, a, b] * factor
                            factor /= k - j + 1
                        doubled[k, a, b] = total / 2.0**k
            for k in range(order + 1):
                for a in range(d):
                    for b in range(d):
                        phi[k, a, b] = doubled[k, a, b]
        for a in range(d):
            for b in range(d):
                noise[i, a, b] = (Q[a, b] + Q[b, a]) / 2
                for k in range(order + 1):
                    phis[k, i, a, b] = phi[k, a, b]
    return phis, noise


@kernel("f3 i1 f3 f3 i1 f i f")
def coupling_integrals(
    M: FloatArray, at: IntArray, C: FloatArray, A: FloatArray, of: IntArray, dt: float, degree: int, radius: float
) -> FloatArray:
    """int_0^dt exp(M_at (dt - s)) C exp(A_of s) ds (m, d_i, d_j) of M (n, d_i, d_i), C (m, d_i, d_j), A (k, d_j, d_j);
    at, of (m,) rows of M and A; degree, radius of the Taylor series as in `phi_and_noise`."""
    m, p, q = C.shape
    rows = np.zeros((len(M), p))
    largest = 0.0
    for i in range(len(M)):
        for a in range(p):
            for b in range(p):
                rows[i, a] += abs(M[i, a, b])
    for j in range(len(A)):
        for a in range(q):
            total = 0.0
            for b in range(q):
                total += abs(A[j, a, b])
            largest = max(largest, total)
    for e in range(m):
        for a in range(p):
            total = rows[at[e], a]
            for b in range(q):
                total += abs(C[e, a, b])
            largest = max(largest, total)
    doublings, norm = 0, largest * dt
    if norm > radius and norm < math.inf:
        doublings = math.ceil(math.log2(norm / radius))
    h = dt / 2.0**doublings
    # second[j, t]: what the series of exp(A_j h) has come to; then the squares of both exponentials
    second, doubled = np.empty((len(A), degree + 1, q, q)), np.empty((len(A), doublings + 1, q, q))
    first, made = np.empty((len(M), doublings + 1, p, p)), np.zeros(len(M), dtype=np.bool_)
    for j in range(len(A)):
        for a in range(q):
            for b in range(q):
                second[j, degree, a, b] = 1.0 if a == b else 0.0
        for t in range(degree, 0, -1):
            for a in range(q):
                for b in range(q):
                    total = 1.0 if a == b else 0.0
                    for c in range(q):
                        total += A[j, a, c] * h / t * second[j, t, c, b]
                    second[j, t - 1, a, b] = total
        for a in range(q):
            for b in range(q):
                doubled[j, 0, a, b] = second[j, 0, a, b]
        for t in range(doublings):
            for a in range(q):
                for b in range(q):
                    total = 0.0
                    for c in range(q):
                        total += doubled[j, t, a, c] * doubled[j, t, c, b]
                    doubled[j, t + 1, a, b] = total
    result = np.empty((m, p, q))
    corner, product, square = np.empty((p, q)), np.empty((p, q)), np.empty((p, p))
    for e in range(m):
        i, j = at[e], of[e]
        if doublings > 0 and not made[i]:
            made[i] = True
            for a in range(p):
                for b in range(p):
                    first[i, 0, a, b] = 1.0 if a == b else 0.0
            for t in range(degree, 0, -1):
                for a in range(p):
                    for b in range(p):
                        square[a, b] = 1.0 if a == b else 0.0
                    for c in range(p):
                        z = M[i, a, c] * h / t
                        if z != 0.0:
                            for b in range(p):
                                square[a, b] += z * first[i, 0, c, b]
                for a in range(p):
                    for b in range(p):
                        first[i, 0, a, b] = square[a, b]
            for t in range(doublings):
                for a in range(p):
                    for b in range(p):
                        total = 0.0
                        for c in range(p):
                            total += first[i, t, a, c] * first[i, t, c, b]
                        first[i, t + 1, a, b] = total
        for a in range(p):
            for b in range(q):
                corner[a, b] = 0.0
        for t in range(degree, 0, -1):
            for a in range(p):
                for b in range(q):
                    product[a, b] = 0.0
                for c in range(p):
                    z = M[i, a, c]
                    if z != 0.0:
                        for b in range(q):
                            product[a, b] += z * corner[c, b]
                for c in range(q):
                    z = C[e, a, c]
                    if z != 0.0:
                        for b in range(q):
                            product[a, b] += z * second[j, t, c, b]
            for a in range(p):
                for b in range(q):
                    corner[a, b] = product[a, b] * h / t
        for t in range(doublings):
            for a in range(p):
                for b in range(q):
                    total = 0.0
                    for c in range(p):
                        total += first[i, t, a, c] * corner[c, b]
                    for c in range(q):
                        total += corner[a, c] * doubled[j, t, c, b]
                    product[a, b] = total
            for a in range(p):
                for b in range(q):
                    corner[a, b] = product[a, b]
        for a in range(p):
            for b in range(q):
                result[e, a, b] = corner[a, b]
    return result

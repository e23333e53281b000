r"""Exponentials of many small matrices and the integrals over them, see `saga_fg.model.discretisation`.

    phi_k(M dt),   Q = int_0^dt exp(M s) Qc exp(M^T s) ds,   int_0^dt exp(M (dt - s)) C exp(A s) ds

Matrices are mostly zeros, which their products leave out.
"""

import math

import numpy as np

from saga_fg.kernels.compilation import FloatArray, IntArray, kernel, kernel_part


@kernel_part
def _add_product(out: FloatArray, A: FloatArray, B: FloatArray) -> None:
    """Add A B to `out`."""
    for a in range(A.shape[0]):
        for c in range(A.shape[1]):
            z = A[a, c]
            if z != 0.0:
                for b in range(B.shape[1]):
                    out[a, b] += z * B[c, b]


@kernel_part
def _set_product(out: FloatArray, A: FloatArray, B: FloatArray) -> None:
    """Set `out` to A B."""
    for a in range(out.shape[0]):
        for b in range(out.shape[1]):
            out[a, b] = 0.0
    _add_product(out, A, B)


@kernel_part
def _set_scaled(out: FloatArray, A: FloatArray, factor: float) -> None:
    """Set `out` to A times a number: by loops, which compile in a tenth of the time of assigned slices."""
    for a in range(out.shape[0]):
        for b in range(out.shape[1]):
            out[a, b] = A[a, b] * factor


@kernel_part
def _add_scaled(out: FloatArray, A: FloatArray, factor: float) -> None:
    """Add A times a number to `out`."""
    for a in range(out.shape[0]):
        for b in range(out.shape[1]):
            out[a, b] += A[a, b] * factor


@kernel_part
def _largest_row(M: FloatArray) -> float:
    """Norm of M: the largest sum of magnitudes of a row."""
    largest = 0.0
    for a in range(M.shape[0]):
        total = 0.0
        for b in range(M.shape[1]):
            total += abs(M[a, b])
        largest = max(largest, total)
    return largest


@kernel_part
def _halvings(norm: float, radius: float) -> int:
    """Number of halvings after which a norm is at most `radius`."""
    return math.ceil(math.log2(norm / radius)) if radius < norm < math.inf else 0


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
    phi, doubled = np.empty((order + 1, d, d)), np.empty((order + 1, d, d))
    for i in range(m):
        doublings = _halvings(_largest_row(M[i]) * dt, radius)
        h = dt / 2.0**doublings
        _set_scaled(Z, M[i], h)
        inverse = 1.0  # 1 / (order + degree)!
        for j in range(2, order + degree + 1):
            inverse /= j
        for a in range(d):
            for b in range(d):
                phi[order, a, b] = inverse if a == b else 0.0
        for j in range(degree - 1, -order - 1, -1):  # phi_order by Horner's rule, then the lower ones
            k = order + min(j, 0)
            inverse *= order + j + 1
            _set_product(product, Z, phi[min(k + 1, order)])
            for a in range(d):
                product[a, a] += inverse
            _set_scaled(phi[k], product, 1.0)
        Q = noise[i]
        _set_scaled(term, Qc[i], h)
        _set_scaled(Q, term, 1.0)
        for j in range(2, noise_degree + 1):
            _set_product(product, Z, term)
            for a in range(d):
                for b in range(d):
                    term[a, b] = (product[a, b] + product[b, a]) / j
                    Q[a, b] += term[a, b]
        for _ in range(doublings):
            for a in range(d):
                for b in range(d):
                    term[a, b] = phi[0, b, a]
            _set_product(turned, phi[0], Q)
            _add_product(Q, turned, term)  # Q + phi_0 Q phi_0^T
            for k in range(order + 1):
                _set_product(product, phi[0], phi[k])
                factor = 1.0
                for j in range(k, 0, -1):  # phi_j / (k - j)!
                    _add_scaled(product, phi[j], factor)
                    factor /= k - j + 1
                _set_scaled(doubled[k], product, 1 / 2.0**k)
            for k in range(order + 1):
                _set_scaled(phi[k], doubled[k], 1.0)
        for a in range(d):
            for b in range(a):
                middle = (Q[a, b] + Q[b, a]) / 2
                Q[a, b] = middle
                Q[b, a] = middle
        for k in range(order + 1):
            _set_scaled(phis[k, i], phi[k], 1.0)
    return phis, noise


@kernel_part
def _exponential_series(out: FloatArray, M: FloatArray, h: float) -> None:
    """Taylor series of exp(M h) by Horner's rule into `out` (degree + 1, d, d): from its innermost bracket, last, to
    the whole."""
    degree, d, Z = out.shape[0] - 1, M.shape[0], np.empty(M.shape)
    for t in range(degree, -1, -1):
        for a in range(d):
            for b in range(d):
                out[t, a, b] = 1.0 if a == b else 0.0
        if t < degree:
            _set_scaled(Z, M, h / (t + 1))
            _add_product(out[t], Z, out[t + 1])


@kernel_part
def _squares(out: FloatArray, M: FloatArray) -> None:
    """M, M^2, M^4, ... into `out` (count + 1, d, d)."""
    _set_scaled(out[0], M, 1.0)
    for t in range(out.shape[0] - 1):
        _set_product(out[t + 1], out[t], out[t])


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
        largest = max(largest, _largest_row(A[j]))
    for e in range(m):
        for a in range(p):
            total = rows[at[e], a]
            for b in range(q):
                total += abs(C[e, a, b])
            largest = max(largest, total)
    doublings = _halvings(largest * dt, radius)
    h = dt / 2.0**doublings
    # second[j, t]: what the series of exp(A_j h) has come to; then the squares of both exponentials
    second, doubled = np.empty((len(A), degree + 1, q, q)), np.empty((len(A), doublings + 1, q, q))
    first, made = np.empty((len(M), doublings + 1, p, p)), np.zeros(len(M), dtype=np.bool_)
    A_j = np.empty((q, q))
    for j in range(len(A)):
        _set_scaled(A_j, A[j], 1.0)
        _exponential_series(second[j], A_j, h)
        _squares(doubled[j], second[j, 0])
    result, begin, own = np.empty((m, p, q)), 0, np.empty((degree + 1, p, p))
    M_i, C_e, whole = np.empty((p, p)), np.empty((p, q)), np.empty((p, q))  # parts are compiled once for such arrays
    while begin < m:  # the edges of a node at once, side by side
        i, j, end, known = at[begin], of[begin], begin, 0
        while end < m and at[end] == i and of[end] == j:
            end += 1
        corner, product = np.zeros((p, (end - begin) * q)), np.empty((p, (end - begin) * q))
        place, value = np.empty((corner.size, 3), dtype=np.int64), np.empty(corner.size)  # of what is not zero in C
        for e in range(begin, end):
            for a in range(p):
                for b in range(q):
                    if C[e, a, b] != 0.0:
                        place[known, 0], place[known, 1], place[known, 2] = a, b, (e - begin) * q
                        value[known] = C[e, a, b]
                        known += 1
        _set_scaled(M_i, M[i], 1.0)
        for t in range(degree, 0, -1):
            _set_product(product, M_i, corner)
            for k in range(known):
                for b in range(q):
                    product[place[k, 0], place[k, 2] + b] += value[k] * second[j, t, place[k, 1], b]
            _set_scaled(corner, product, h / t)
        if doublings > 0 and not made[i]:
            made[i] = True
            _exponential_series(own, M_i, h)
            _squares(first[i], own[0])
        for e in range(begin, end):
            for a in range(p):
                for b in range(q):
                    C_e[a, b] = corner[a, (e - begin) * q + b]
            for t in range(doublings):
                _set_product(whole, first[i, t], C_e)
                _add_product(whole, C_e, doubled[j, t])
                _set_scaled(C_e, whole, 1.0)
            _set_scaled(result[e], C_e, 1.0)
        begin = end
    return result


@kernel("f3 f3 i1 f3 f2 f3 f2 b")
def with_motions(
    values: FloatArray,
    noise: FloatArray,
    at: IntArray,
    F: FloatArray,
    b: FloatArray,
    Q: FloatArray,
    back: FloatArray,
    coupled: bool,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Blocks of F and Q (m, d, d) with the motions F, b, Q (n, d, d), (n, d), at (m,): row of the motion, -1 for none;
    and b: if `coupled`, G F, G b and G Q G^T with G = `values` `back` (d, d)."""
    m, d, _ = values.shape
    own, noises, constants = values.copy(), noise.copy(), b.copy()
    G, other, product, turned = np.empty((d, d)), np.empty((d, d)), np.empty((d, d)), np.empty((d, d))
    for k in range(m):
        i = at[k]
        if i < 0:
            continue
        if not coupled:
            _set_scaled(own[k], F[i], 1.0)
            for p in range(d):
                for q in range(d):
                    noises[k, p, q] = (Q[i, p, q] + Q[i, q, p]) / 2
            continue
        _set_scaled(turned, values[k], 1.0)
        _set_scaled(other, back, 1.0)
        _set_product(G, turned, other)
        _set_scaled(other, F[i], 1.0)
        _set_product(product, G, other)
        _set_scaled(own[k], product, 1.0)
        _set_scaled(other, Q[i], 1.0)
        _set_product(product, G, other)
        for p in range(d):
            constants[i, p] = 0.0
            for q in range(d):
                constants[i, p] += G[p, q] * b[i, q]
                turned[p, q] = G[q, p]
        _set_product(other, product, turned)
        for p in range(d):
            for q in range(d):
                noises[k, p, q] = (other[p, q] + other[q, p]) / 2
    return own, noises, constants

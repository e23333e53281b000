r"""Pairwise costs of two associations, for matching a graph to a graph.

Track i is predicted at m_i, tracks i and j with the joint covariance of the filter; detection a is at z_a. If a is i's
and b is j's, the two innovations are jointly Gaussian, and the two associations are not independent:

    nu_ia = z_a - m_i        S_ia = P_ii + R_a        nu = (nu_ia, nu_jb)        S = [ S_ia  P_ij ; P_ji  S_jb ]

    c_ij(a, b) = ( nu^T S^-1 nu + log det S ) - ( nu_ia^T S_ia^-1 nu_ia + log det S_ia ) - ( ... the same of j, b )

that is -2 log of the joint likelihood over the product of the two. It is small where both detections are displaced
alike, as the relative position of i and j is known better than either position. With the whitened U = L_ia^-1 P_ij
L_jb^-T, L L^T = S, and u = L^-1 nu, it is a function of 2x2 matrices alone:

    c = log det( I - U U^T ) + v^T ( I - U U^T )^-1 v - u_ia^T u_ia,       v = u_ia - U u_jb

Among k objects that move as one there are k (k - 1) / 2 such terms, which would count their common information k / 2
times. A tree of k - 1 of them makes a proper density; every spanning tree does. The costs are the mean over all trees,
sampled with weights proportional to the mutual information I_ij of the two predictions: each term is multiplied by the
probability that its edge is in the tree, by Kirchhoff's theorem I_ij times the resistance between i and j in a network
of the conductances I (Wainwright, Jaakkola, Willsky, A new class of upper bounds on the log partition function, IEEE
Trans. Information Theory 51, 2005). For two objects that is exactly the joint likelihood.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.quadratic_matching import PairCosts

PARTNERS = 4  # of each track, the most informative
LEAST_INFORMATION = 1e-4  # nats; tracks with less mutual information are taken for independent


class CrossCovariances(NamedTuple):
    """Covariances (E, 2, 2), m^2, of the positions of tracks `first` (E,) with those of tracks `second` (E,), rows of a
    table; each pair of tracks once, those that are not named are independent."""

    first: IntArray
    second: IntArray
    covariance: FloatArray


def pair_costs(
    track: IntArray, detection: IntArray, innovation: FloatArray, S: FloatArray, cross: CrossCovariances
) -> PairCosts:
    """The costs between K candidates, pairs of a track and a detection.

    track (K,), detection (K,); innovation (K, 2), m; S (K, 2, 2) its covariance, m^2.
    """
    whitening = _inverse_root(S)
    tree, weight = tree_edges(track, whitening, cross)
    i, j, C = tree
    order = np.argsort(track, kind="stable")
    count = np.bincount(track, minlength=int(max(i.max(initial=0), j.max(initial=0))) + 1)
    start = np.cumsum(count) - count
    number = count[i] * count[j]
    edge = np.repeat(np.arange(len(i)), number)
    within = np.arange(len(edge)) - np.repeat(np.cumsum(number) - number, number)
    first = order[start[i[edge]] + within // count[j[edge]]]
    second = order[start[j[edge]] + within % count[j[edge]]]
    apart = detection[first] != detection[second]
    edge, first, second = edge[apart], first[apart], second[apart]
    u = (whitening @ innovation[:, :, None])[:, :, 0]
    U = whitening[first] @ C[edge] @ np.swapaxes(whitening[second], 1, 2)
    return PairCosts(first, second, weight[edge] * _cost(u[first], u[second], U))


def tree_edges(track: IntArray, whitening: FloatArray, cross: CrossCovariances) -> tuple[CrossCovariances, FloatArray]:
    """The pairs of tracks with mutual information, and (E,) the share of spanning trees that contain them.

    whitening (K, 2, 2): L^-1 of the candidates of tracks `track` (K,), S = L L^T; the first of each track's serves
    """
    seen, at = np.unique(track, return_index=True)
    i, j, C = cross
    row = np.full(int(max(i.max(initial=0), j.max(initial=0), seen.max(initial=0))) + 1, -1)
    row[seen] = at
    there = (row[i] >= 0) & (row[j] >= 0)
    i, j, C = i[there], j[there], C[there]
    U = whitening[row[i]] @ C @ np.swapaxes(whitening[row[j]], 1, 2)
    information = -0.5 * np.log(_determinant(np.eye(2) - U @ np.swapaxes(U, 1, 2)))
    kept = np.flatnonzero(information > LEAST_INFORMATION)
    mutual = information[kept]
    strongest = _strongest(np.concatenate([i[kept], j[kept]]), np.concatenate([mutual, mutual]))
    kept = kept[np.unique(strongest % max(len(kept), 1))]
    i, j, information = i[kept], j[kept], information[kept]
    return CrossCovariances(i, j, C[kept]), information * _resistance(i, j, information)


def _strongest(group: IntArray, value: FloatArray) -> IntArray:
    """The entries of the greatest values, `PARTNERS` of each group."""
    order = np.lexsort((-value, group))
    leads = np.diff(group[order], prepend=-1) != 0
    rank = np.arange(len(order)) - np.maximum.accumulate(np.where(leads, np.arange(len(order)), 0))
    return order[rank < PARTNERS]


def _resistance(i: IntArray, j: IntArray, conductance: FloatArray) -> FloatArray:
    """(E,) between the ends of every edge, in the network of all of them."""
    if len(i) == 0:
        return np.empty(0)
    nodes, at = np.unique(np.concatenate([i, j]), return_inverse=True)
    a, b, k = at[: len(i)], at[len(i) :], len(nodes)
    ties = scipy.sparse.coo_array((conductance, (a, b)), shape=(k, k))
    parts, part = connected_components(ties, directed=False)
    order = np.argsort(part, kind="stable")
    size = np.bincount(part)
    slot = np.empty(k, dtype=np.int64)
    slot[order] = np.arange(k) - (np.cumsum(size) - size)[part[order]]
    # the Laplacian of each part, in the corner of a matrix that is otherwise the identity
    L = np.tile(np.eye(int(size.max())), (parts, 1, 1))
    L[part, slot, slot] = np.bincount(a, conductance, k) + np.bincount(b, conductance, k)
    L[part[a], slot[a], slot[b]] = L[part[a], slot[b], slot[a]] = -conductance
    # which is singular: fixing the level by a conductance to ground everywhere changes no difference
    ground = np.bincount(part, L[part, slot, slot]) / size**2
    inside = np.arange(L.shape[1]) < size[:, None]
    G = np.linalg.inv(L + ground[:, None, None] * (inside[:, :, None] & inside[:, None, :]))
    p, x, y = part[a], slot[a], slot[b]
    return np.asarray(G[p, x, x] + G[p, y, y] - 2 * G[p, x, y])


def _cost(u_i: FloatArray, u_j: FloatArray, U: FloatArray) -> FloatArray:
    """(E,) of whitened innovations (E, 2) with the cross-covariance U (E, 2, 2)."""
    M = np.eye(2) - U @ np.swapaxes(U, 1, 2)
    det = _determinant(M)
    v = u_i - (U @ u_j[:, :, None])[:, :, 0]
    x, y = v[:, 0], v[:, 1]
    square = (M[:, 1, 1] * x * x - 2 * M[:, 0, 1] * x * y + M[:, 0, 0] * y * y) / det
    return np.asarray(np.log(det) + square - (u_i**2).sum(axis=1))


def _determinant(M: FloatArray) -> FloatArray:
    return np.asarray(M[:, 0, 0] * M[:, 1, 1] - M[:, 0, 1] * M[:, 1, 0])


def _inverse_root(S: FloatArray) -> FloatArray:
    """L^-1 (K, 2, 2) of S = L L^T."""
    a = np.sqrt(S[:, 0, 0])
    b = S[:, 1, 0] / a
    c = np.sqrt(S[:, 1, 1] - b * b)
    inverse = np.zeros_like(S)
    inverse[:, 0, 0], inverse[:, 1, 1], inverse[:, 1, 0] = 1 / a, 1 / c, -b / (a * c)
    return inverse

"""Assignment: one to one by linear costs, and with costs of pairs of pairs.

Association: which detection belongs to which track.

    d^2 = (z - H m)^T S^-1 (z - H m),   S = H P H^T + R

A pair is possible where d^2 is inside the chi-square gate and the centres are closer than a cap; the assignment is the
one of least total cost, where an unmatched track or detection costs as much as a pair at the gate.

Pairwise costs of two associations, for matching a graph to a graph.

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

Bipartite matching whose cost also depends on which pairs are chosen together: the quadratic assignment problem.

    minimise    sum_k g_k x_k  +  sum_{k < l} c_kl x_k x_l          x_k in {0, 1}
    such that   at most one candidate k of every track, and of every detection, is chosen

Candidate k is the pair (track_k, detection_k), g_k what it costs beyond leaving both alone. Three stages, the first two
of them exact:

elimination    A candidate that cannot pay, whatever else is chosen, is dropped; one that pays whatever else is chosen,
               even at the expense of all its rivals, is fixed, and its c_kl become part of the others' g_l. Repeated
               until nothing changes (Goldstein, Efficient rotamer elimination, Biophysical Journal 66, 1994).
search         What is left falls apart into components. In each, tracks are decided one after the other; a partial
               decision is abandoned when its cost and a lower bound of what the rest can gain exceed the best known.
beam           Where a component is too large for all partial decisions to be followed, the most promising are.

With all c_kl zero the answer is that of the Hungarian algorithm. `scipy.optimize.quadratic_assignment` takes costs that
are products A_ij B_ab alone, of complete assignments; these here are general, sparse, and leave things unassigned.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, Self

import numpy as np
import scipy.sparse
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from saga_fg.numerics.arrays import BoolArray, Columns, FloatArray, IntArray
from saga_fg.numerics.geometry import chi_square_quantile

_DENSE = 10_000  # pairs of rivals up to which one matrix of all is the fastest


@dataclass(frozen=True, eq=False)
class Matching(Columns):
    """track (k,) and detection (k,): rows that belong together; distance (k,): their d^2.

    share (k,): probability that the detection is this track's and not another one's
    """

    track: IntArray
    detection: IntArray
    distance: FloatArray
    share: FloatArray

    @classmethod
    def empty(cls) -> Self:
        return cls(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty(0), np.empty(0))


@dataclass(frozen=True, eq=False)
class Assignment:
    """id (k,) of tracks, and the row (k,) in the frame of the detection that updated or initiated each."""

    id: IntArray
    detection: IntArray

    @staticmethod
    def empty() -> Assignment:
        return Assignment(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64))


def mahalanobis(
    position: FloatArray, covariance: FloatArray, measured: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Squared distances and log det S, both (n, m), of n predicted positions and m measured ones in the plane.

    position (n, 2), covariance (n, 2, 2), measured (m, 2), noise (m, 2, 2)
    """
    return mahalanobis_of_pairs(measured[None] - position[:, None], covariance[:, None] + noise[None])


def mahalanobis_of_pairs(innovation: FloatArray, S: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Squared distances and log det S, both (...), of innovations (..., 2) with covariances S (..., 2, 2)."""
    dx, dy = innovation[..., 0], innovation[..., 1]
    a, b, c = S[..., 0, 0], S[..., 0, 1], S[..., 1, 1]
    det = a * c - b * b
    return (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / det, np.log(det)


@lru_cache
def gate(probability: float, dim: int = 2) -> float:
    """The chi-square gate that lets `probability` of the true pairs through."""
    return chi_square_quantile(probability, dim)


def assign(cost: FloatArray, possible: BoolArray, unmatched: float | FloatArray) -> tuple[IntArray, IntArray]:
    """Rows and columns of the assignment of least cost (n, m) among possible pairs.

    Leaving a pair out costs `unmatched` (a number, one per track (n, 1), or one per pair); only pairs cheaper than that
    are matched.
    """
    rows, columns = possible.nonzero()
    chosen = least_total(rows, columns, (cost - unmatched)[rows, columns])
    return rows[chosen], columns[chosen]


def least_total(row: IntArray, column: IntArray, gain: FloatArray) -> IntArray:
    """Choose from K candidates, pairs (row, column), the assignment of least total gain; ascending.

    gain (K,): what a candidate costs less than leaving both alone. Candidates without a rival need no assignment.
    """
    paying = (gain < 0).nonzero()[0]
    row, column, gain = row[paying], column[paying], gain[paying]
    alone = (np.bincount(row)[row] == 1) & (np.bincount(column)[column] == 1)
    rival = (~alone).nonzero()[0]
    if len(rival) == 0:
        return paying
    rows, r = np.unique(row[rival], return_inverse=True)
    columns, c = np.unique(column[rival], return_inverse=True)
    if len(rows) * len(columns) <= _DENSE:
        parts = [np.arange(len(rival))]
    else:  # one assignment for each set of rivals, in which nobody shares a row or a column with others
        n, m = len(rows), len(columns)
        _, part = connected_components(coo_array((np.ones(len(r)), (r, n + c)), (n + m, n + m)), directed=False)
        order = np.argsort(part[r], kind="stable")
        parts = np.split(order, np.flatnonzero(np.diff(part[r][order])) + 1)
    for part in parts:
        alone[_assigned(r[part], c[part], gain[rival[part]], rival[part])] = True
    return np.asarray(paying[alone])


def _assigned(row: IntArray, column: IntArray, gain: FloatArray, number: IntArray) -> IntArray:
    """The numbers of the pairs of the assignment of least total gain."""
    rows, r = np.unique(row, return_inverse=True)
    columns, c = np.unique(column, return_inverse=True)
    dense, numbers = np.zeros((len(rows), len(columns))), np.full((len(rows), len(columns)), -1)
    dense[r, c], numbers[r, c] = gain, number
    chosen = numbers[linear_sum_assignment(dense)]
    return np.asarray(chosen[chosen >= 0])


def cheapest_first(row: IntArray, column: IntArray, gain: FloatArray) -> IntArray:
    """Assign greedily: like `least_total`, but the cheapest candidate of the rows and columns left comes first."""
    paying = (gain < 0).nonzero()[0]
    taken_rows: set[int] = set()
    taken_columns: set[int] = set()
    chosen = []
    for k in paying[gain[paying].argsort(kind="stable")].tolist():
        if row[k] not in taken_rows and column[k] not in taken_columns:
            taken_rows.add(int(row[k]))
            taken_columns.add(int(column[k]))
            chosen.append(k)
    return np.sort(np.array(chosen, dtype=np.int64))


LARGEST_FRONTIER = 60_000  # candidates times partial decisions that are followed at a time
_EXACT = 1e-9  # costs closer than this are the same


class PairCosts(NamedTuple):
    """Costs (E,), beyond their own, of choosing candidates `first` (E,) and `second` (E,) together."""

    first: IntArray
    second: IntArray
    cost: FloatArray


@dataclass(frozen=True, eq=False)
class QuadraticMatching:
    """track (K,), detection (K,), gain (K,) of the candidates, and the costs of pairs of candidates.

    Pairs of candidates that share a track or a detection are not expected; each pair is named once.
    """

    track: IntArray
    detection: IntArray
    gain: FloatArray
    pairs: PairCosts

    def cost(self, chosen: BoolArray) -> float:
        """The cost of a choice (K,)."""
        both = chosen[self.pairs.first] & chosen[self.pairs.second]
        return float(self.gain[chosen].sum() + self.pairs.cost[both].sum())

    def solve(self) -> IntArray:
        """The chosen candidates, in ascending order."""
        open_, chosen, gain = _eliminated(self)
        rows = np.flatnonzero(open_)
        if len(rows):
            for part in _components(self, rows, open_):
                chosen[part[_solve_part(self, part, gain)]] = True
        return np.flatnonzero(chosen)


def _eliminated(problem: QuadraticMatching) -> tuple[BoolArray, BoolArray, FloatArray]:
    """Candidates still open, those fixed, and what the open ones cost given these: (K,) each."""
    track, detection, K = problem.track, problem.detection, len(problem.track)
    first = np.concatenate([problem.pairs.first, problem.pairs.second])
    second = np.concatenate([problem.pairs.second, problem.pairs.first])
    cost = np.concatenate([problem.pairs.cost, problem.pairs.cost])
    order = np.lexsort((track[second], first))  # by candidate and partner track: one run for each such pair
    first, second, cost = first[order], second[order], cost[order]
    open_, chosen, gain = np.ones(K, dtype=bool), np.zeros(K, dtype=bool), problem.gain.copy()
    while open_.any():
        usable = open_[first] & open_[second]
        first, second, cost = first[usable], second[usable], cost[usable]
        low, high = gain.copy(), gain.copy()
        if len(first):
            starts = np.flatnonzero(np.diff(first, prepend=-1) | np.diff(track[second], prepend=-1))
            low += np.bincount(first[starts], np.minimum(np.minimum.reduceat(cost, starts), 0.0), K)
            high += np.bincount(first[starts], np.maximum(np.maximum.reduceat(cost, starts), 0.0), K)
        hopeless = open_ & (low >= 0)
        open_ &= ~hopeless
        rivals = _best_rival(low, track, open_) + _best_rival(low, detection, open_)
        sure = open_ & (high < rivals - _EXACT)
        if not (hopeless.any() or sure.any()):
            break
        chosen |= sure
        taken_track, taken_detection = np.isin(track, track[sure]), np.isin(detection, detection[sure])
        settled = sure[first] & open_[second]
        gain += np.bincount(second[settled], cost[settled], K)
        open_ &= ~(taken_track | taken_detection)
    return open_, chosen, gain


def _best_rival(low: FloatArray, group: IntArray, open_: BoolArray) -> FloatArray:
    """(K,) the least `low`, at most 0, among the other open candidates of the same group."""
    rows = np.flatnonzero(open_)
    rows = rows[np.lexsort((low[rows], group[rows]))]
    leads = np.diff(group[rows], prepend=-1) != 0
    starts = np.flatnonzero(leads)
    run = np.cumsum(leads) - 1
    best = low[rows[starts]]
    following = np.append(leads[1:], True)  # rows that are the last of their run
    second = np.where(following[starts], 0.0, low[rows[np.minimum(starts + 1, len(rows) - 1)]])
    result = np.zeros(len(low))
    result[rows] = np.minimum(np.where(leads, second[run], best[run]), 0.0)
    return result


def _components(problem: QuadraticMatching, rows: IntArray, open_: BoolArray) -> list[IntArray]:
    """The open candidates in parts that share neither track nor detection nor a cost."""
    pairs = problem.pairs
    tied = open_[pairs.first] & open_[pairs.second] & (pairs.cost != 0)
    K = len(problem.track)
    track = np.unique(problem.track, return_inverse=True)[1] + K
    detection = np.unique(problem.detection, return_inverse=True)[1] + 2 * K
    a = np.concatenate([rows, rows, pairs.first[tied]])
    b = np.concatenate([track[rows], detection[rows], pairs.second[tied]])
    links = scipy.sparse.coo_array((np.ones(len(a), dtype=np.int8), (a, b)), shape=(3 * K, 3 * K))
    label = connected_components(links, directed=False)[1][rows]
    order = np.argsort(label, kind="stable")
    return np.split(rows[order], np.flatnonzero(np.diff(label[order])) + 1)


def _solve_part(problem: QuadraticMatching, part: IntArray, gain: FloatArray) -> IntArray:
    """The chosen ones among the candidates `part` of one component."""
    track = np.unique(problem.track[part], return_inverse=True)[1].astype(np.int64)
    detection = np.unique(problem.detection[part], return_inverse=True)[1].astype(np.int64)
    C = np.zeros((len(part), len(part)))
    at = np.full(len(problem.track), -1)
    at[part] = np.arange(len(part))
    first, second = at[problem.pairs.first], at[problem.pairs.second]
    inside = (first >= 0) & (second >= 0)
    C[first[inside], second[inside]] = C[second[inside], first[inside]] = problem.pairs.cost[inside]
    order = _coupled_order(C, track, int(track.max()) + 1)
    by_turn = np.argsort(np.argsort(order)[track], kind="stable")
    chosen = _search(order.argsort()[track[by_turn]], detection[by_turn], gain[part][by_turn], C[by_turn][:, by_turn])
    return by_turn[chosen]


def _coupled_order(C: FloatArray, track: IntArray, tracks: int) -> IntArray:
    """The tracks, the most strongly coupled first, then always the one most coupled to those before it."""
    coupling = np.zeros((tracks, tracks))
    np.maximum.at(coupling, (track[:, None], track), np.abs(C))
    reach = coupling.sum(axis=1) * 1e-6
    order = np.empty(tracks, dtype=np.int64)
    for turn in range(tracks):
        order[turn] = int(reach.argmax())
        reach += coupling[order[turn]]
        reach[order[: turn + 1]] = -np.inf
    return order


def _search(track: IntArray, detection: IntArray, gain: FloatArray, C: FloatArray) -> IntArray:
    """The best choice among candidates in the order of their tracks, 0 to T - 1, each of which has one at least."""
    K, T = len(track), int(track[-1]) + 1
    starts = np.searchsorted(track, np.arange(T))
    best, chosen = _incumbent(track, detection, gain, C)
    # what a candidate can gain by partners still to come, half of it its own: (K, T), then after each turn (K, T + 1)
    promise = np.minimum(np.minimum.reduceat(C, starts, axis=1), 0.0) / 2
    later = np.zeros((K, T + 1))
    later[:, :-1] = np.cumsum(promise[:, ::-1], axis=1)[:, ::-1]
    blocks = detection[:, None] == detection
    cost, value = np.zeros(1), gain[None].copy()  # value (h, K): what each candidate would cost each partial decision
    history = []
    for turn in range(T):
        mine = np.arange(starts[turn], starts[turn + 1] if turn + 1 < T else K)
        options = np.concatenate([np.zeros((len(cost), 1)), value[:, mine]], axis=1)
        total = cost[:, None] + options
        parent, option = np.nonzero(np.isfinite(total))
        total = total[parent, option]
        value = value[parent]
        takes = np.flatnonzero(option)
        taken = mine[option[takes] - 1]
        value[takes] += C[taken]
        value[takes] = np.where(blocks[taken], np.inf, value[takes])
        bound = total
        if turn + 1 < T:
            rest = slice(int(starts[turn + 1]), K)
            hope = np.minimum.reduceat(value[:, rest] + later[rest, turn + 1], starts[turn + 1 :] - rest.start, axis=1)
            bound = total + np.minimum(hope, 0.0).sum(axis=1)
        kept = np.flatnonzero(bound < best - _EXACT)
        if len(kept) == 0:
            return chosen
        most = max(LARGEST_FRONTIER // K, 1)
        if len(kept) > most:
            kept = kept[np.argpartition(bound[kept], most - 1)[:most]]
        cost, value = total[kept], value[kept]
        history.append((parent[kept], np.where(option[kept] > 0, mine[option[kept] - 1], -1)))
    at = int(cost.argmin())
    decided = []
    for parents, candidate in reversed(history):
        decided.append(int(candidate[at]))
        at = int(parents[at])
    return np.array([k for k in reversed(decided) if k >= 0], dtype=np.int64)


def _incumbent(track: IntArray, detection: IntArray, gain: FloatArray, C: FloatArray) -> tuple[float, IntArray]:
    """Cost of the assignment of least g, and that assignment."""
    chosen = least_total(track, detection, gain)
    return float(gain[chosen].sum() + C[np.ix_(chosen, chosen)].sum() / 2), chosen


PARTNERS = 4  # of each track, the most informative
MIN_INFORMATION = 1e-4  # nats; tracks with less mutual information are taken for independent


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
    kept = np.flatnonzero(information > MIN_INFORMATION)
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

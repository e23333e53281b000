r"""Bipartite matching whose cost also depends on which pairs are chosen together: the quadratic assignment problem.

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
from typing import NamedTuple

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.assignment import least_total

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

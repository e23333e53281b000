"""Merging of landmarks that were initiated twice while the pose was poorly known.

    delta_ij = l_j - l_i in the tangent,        S_ij = P_ii + P_jj - P_ij - P_ji

Two of a kind may be one where d^2 = delta^T S^-1 delta is inside the gate, unless they were seen together from one
pose. A single pair says little where S is large. But differences are correlated: if one pair is one landmark, the
others are known much better. For a set of pairs the odds of being one against being two multiply, each pair given those
before it (chain rule),

    log odds(set) = sum_k log odds( delta_k | delta_1 = 0, ..., delta_{k-1} = 0 )

so that a constellation is recognised where no single landmark is. From each pair as a seed the set grows by the
likeliest pair as long as that raises the odds; the likeliest set of all is merged, if its odds are better than even.
The idea of judging pairs jointly is that of J. Neira and J. D. Tardos (IEEE Transactions on Robotics and Automation 17,
2001).
"""

from __future__ import annotations

from collections.abc import Set
from itertools import combinations

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.assignment import gate
from saga_fg.slam.mapping.association import log_odds
from saga_fg.slam.mapping.local_map import LocalMap

_SEEDS = 40  # pairs that sets are grown from, the likeliest


def duplicates(local: LocalMap, probability: float, seen_together: Set[tuple[int, int]]) -> dict[int, int]:
    """Find landmarks to merge: number -> the lower number of the same landmark; each occurs once.

    probability: of the gate; seen_together: pairs (lower, higher) of different landmarks, seen from one pose.
    """
    merged: dict[int, int] = {}
    for kind in dict.fromkeys(local.kinds.values()):
        numbers = sorted(number for number, other in local.kinds.items() if other == kind)
        pairs = _possible(local, list(combinations(numbers, 2)), probability, seen_together)
        if not pairs:
            continue
        delta, J_i, J_j = local.differences(pairs)
        covariance = local.joint_difference_covariance(pairs, J_i, J_j)
        chosen = _likeliest_set(pairs, delta, covariance, kind.density, probability)
        merged |= {pairs[k][1]: pairs[k][0] for k in chosen}
    return merged


def _possible(
    local: LocalMap, every: list[tuple[int, int]], probability: float, seen_together: Set[tuple[int, int]]
) -> list[tuple[int, int]]:
    """Pairs inside the gate."""
    pairs = [pair for pair in every if pair not in seen_together]
    if not pairs:
        return []
    delta, J_i, J_j = local.differences(pairs)
    S = local.difference_covariances(pairs, J_i, J_j)
    squared = (delta * np.linalg.solve(S, delta[:, :, None])[:, :, 0]).sum(axis=1)
    return [pairs[k] for k in np.flatnonzero(squared < gate(probability, delta.shape[1])).tolist()]


def _likeliest_set(
    pairs: list[tuple[int, int]], delta: FloatArray, covariance: FloatArray, density: float, probability: float
) -> list[int]:
    """Rows of the pairs of the likeliest set; delta (K, d) and their joint covariance (K, d, K, d)."""
    best, chosen = 0.0, list[int]()
    everything = np.arange(len(pairs))
    seeds = np.argsort(-_odds(delta, covariance, everything, density, probability))[:_SEEDS]
    for seed in seeds.tolist():
        total, rows, row = 0.0, list[int](), seed
        free = everything
        mean, C = delta.copy(), covariance.copy()
        won = float(_odds(mean, C, np.array([seed]), density, probability)[0])
        while True:
            total += won
            rows.append(row)
            free = np.array([k for k in free if not {*pairs[k]} & {*pairs[row]}], dtype=np.int64)
            if not len(free):
                break
            across = C[row].reshape(mean.shape[1], -1)
            gain = np.linalg.solve(C[row, :, row], across).T.reshape(*mean.shape, -1)
            mean = mean - gain @ mean[row]
            C = C - np.einsum("kij,jlm->kilm", gain, C[row])
            odds = _odds(mean, C, free, density, probability)
            row, won = int(free[np.argmax(odds)]), float(odds.max())
            if won <= 0:
                break
        if total > best:
            best, chosen = total, rows
    return chosen


def _odds(delta: FloatArray, covariance: FloatArray, rows: IntArray, density: float, probability: float) -> FloatArray:
    """Log odds of each of some pairs; minus infinity outside the gate."""
    S = covariance[rows, :, rows]
    squared = (delta[rows] * np.linalg.solve(S, delta[rows, :, None])[:, :, 0]).sum(axis=1)
    odds = log_odds(squared, np.linalg.slogdet(S)[1], delta.shape[1], density)
    return np.where(squared < gate(probability, delta.shape[1]), odds, -np.inf)

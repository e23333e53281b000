"""Landmarks near a pose, and those that are merged.

Merging of landmarks that were initiated twice while the pose was poorly known.

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

Which landmarks can be seen from near a pose, so that neither association nor merging looks at the whole map.

What is observed stands somewhere in the frame of its pose: at the coordinates that its type gives there to the initial
state (of a wall or a line, the foot of the perpendicular). Where that was in the world, over all observations of a
landmark, is its region, a box along the axes. From a place it can be seen if its region is nearer than

    reach + travel + k sigma,        sigma = min( sigma_pose + sigma_landmark, sqrt(tr Q_t + s^2 tr Q_R) )

reach: the farthest that anything was seen; travel: the way on which the answer holds; sigma: of its place relative to
the pose, at most what both have in the world, and at most what odometry has added on the s metres since it was seen
last, Q_t of translation and Q_R of rotation. So neither a large map nor a long way without loops makes the answer long.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from itertools import combinations

import numpy as np

from factors import Vector
from factors.manifolds import central_differences
from saga_fg.numerics import FloatArray, IntArray, gate
from saga_fg.slam.mapping import LocalMap, log_odds
from saga_fg.slam.mapping.local_map import initial_state
from saga_fg.types import Observation

_SAME = 1e-6  # variance of the difference of a landmark from itself, for the numerics
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
        delta, J = _differences(local, pairs)
        covariance = _joint_covariance(local, pairs, J)
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
    delta, J = _differences(local, pairs)
    S = _covariances(local, pairs, J)
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


def _differences(local: LocalMap, pairs: Sequence[tuple[int, int]]) -> tuple[FloatArray, FloatArray]:
    """Differences of K pairs of one kind: l_j in the tangent of l_i (K, d), and Jacobians by both (K, d, 2 d)."""
    variable = local.kinds[pairs[0][0]].variable
    states = {number: local.state(number) for number in {number for pair in pairs for number in pair}}
    if isinstance(variable, Vector):
        first, second = (np.stack([states[pair[side]] for pair in pairs]) for side in (0, 1))
        one = np.eye(variable.dim)
        return second - first, np.broadcast_to(np.hstack([-one, one]), (len(pairs), variable.dim, 2 * variable.dim))
    both = [(states[i], states[j]) for i, j in pairs]
    delta = np.stack([variable.local(i, j) for i, j in both])
    J = [np.hstack(central_differences(variable.local, pair, (variable, variable))) for pair in both]
    return delta, np.stack(J)


def _covariances(local: LocalMap, pairs: Sequence[tuple[int, int]], J: FloatArray) -> FloatArray:
    """The covariance (K, d, d) of each difference."""
    numbers, d = sorted({number for pair in pairs for number in pair}), J.shape[1]
    P = local.covariance(numbers).reshape(len(numbers), d, len(numbers), d)
    rows = np.searchsorted(numbers, pairs)
    both = P[rows[:, :, None], :, rows[:, None, :], :].swapaxes(2, 3).reshape(len(pairs), 2 * d, 2 * d)
    return np.asarray(J @ both @ J.swapaxes(1, 2) + _SAME * np.eye(d))


def _joint_covariance(local: LocalMap, pairs: Sequence[tuple[int, int]], J: FloatArray) -> FloatArray:
    """The covariance (K, d, K, d) of all differences together."""
    numbers, (count, d, _) = sorted({number for pair in pairs for number in pair}), J.shape
    A = np.zeros((count, d, len(numbers), d))
    for k, (i, j) in enumerate(np.searchsorted(numbers, pairs).tolist()):
        A[k, :, i], A[k, :, j] = J[k, :, :d], J[k, :, d:]
    flat = A.reshape(count * d, -1)
    C = flat @ local.covariance(numbers) @ flat.T + _SAME * np.eye(count * d)
    return np.asarray(C.reshape(count, d, count, d))


_TRAVEL = 2.0  # of the reach
_SIGMAS = 4.0  # standard deviations, of a sum of variances over all axes


class NearbyLandmarks:
    """Regions of landmarks by number, counted from 1, and the way of the vehicle."""

    def __init__(self) -> None:
        self.reach = 0.0  # m
        self._way = np.zeros(3)  # variance of translation, m^2, and of rotation, rad^2, and metres, since the start
        self._box = np.empty((64, 2, 2))  # smallest and largest x and y
        self._then = np.empty((64, 3))  # `_way` when each was seen last
        self._sigma = np.full(64, -1.0)  # of its place in the world, m; below 0 where there is no such landmark

    @property
    def travel(self) -> float:
        """Metres on which the landmarks near a place are all that can be seen."""
        return _TRAVEL * self.reach

    def move(self, a_T_b: FloatArray, covariance: FloatArray) -> None:
        """Go on by odometry: a_T_b (d + 1, d + 1), covariance of its tangent."""
        self._way += np.array([*_variances(covariance), float(np.linalg.norm(a_T_b[:-1, -1]))])

    def see(self, landmark: int, place: FloatArray, world_T_pose: FloatArray, covariance: FloatArray) -> None:
        """Note where a landmark was seen from a pose: place (2,) in its frame, covariance of the pose's tangent."""
        while landmark >= len(self._sigma):
            self._box, self._then = (np.concatenate([a, np.empty_like(a)]) for a in (self._box, self._then))
            self._sigma = np.concatenate([self._sigma, np.full_like(self._sigma, -1.0)])
        distance = float(np.linalg.norm(place))
        self.reach = max(self.reach, distance)
        there = world_T_pose[:2, :2] @ place + world_T_pose[:2, -1]
        sigma, box = _sigma(_variances(covariance), distance), np.stack([there, there])
        if self._sigma[landmark] >= 0:
            sigma = min(sigma, self._sigma[landmark])
            box = np.stack([np.minimum(box[0], self._box[landmark, 0]), np.maximum(box[1], self._box[landmark, 1])])
        self._box[landmark], self._then[landmark], self._sigma[landmark] = box, self._way, sigma

    def merge(self, merged: int, kept: int) -> None:
        """Let one landmark be another."""
        low, high = (extreme(self._box[[merged, kept], side], axis=0) for side, extreme in enumerate((np.min, np.max)))
        self._box[kept] = low, high
        self._then[kept] = np.maximum(self._then[merged], self._then[kept])
        self._sigma[kept] = min(self._sigma[merged], self._sigma[kept])
        self._sigma[merged] = -1.0

    def centre(self, landmark: int) -> FloatArray:
        """The middle (2,) of a region."""
        return np.asarray(self._box[landmark].mean(axis=0))

    def near(self, place: FloatArray, covariance: FloatArray) -> IntArray:
        """Numbers of the landmarks that can be seen from within `travel` of a place (2,); covariance: of the pose."""
        numbers = np.flatnonzero(self._sigma >= 0)
        box, since = self._box[numbers], self._way - self._then[numbers]
        distance = np.linalg.norm(np.maximum(box[:, 0] - place, place - box[:, 1]).clip(0), axis=1)
        sigma = _sigma(_variances(covariance), self.reach) + self._sigma[numbers]
        since_seen = (since[:, 0] + since[:, 1] * since[:, 2] ** 2, since[:, 1])
        sigma = np.minimum(sigma, _sigma(since_seen, self.reach))
        return np.asarray(numbers[distance <= self.reach + self.travel + _SIGMAS * sigma])


def place_of(observation: Observation) -> FloatArray:
    """Where an observation stands in the frame of its pose (2,), m. Raises `InputError` naming its type."""
    kind = observation.kind
    where = kind.coordinates(initial_state(observation, np.eye(4 if kind.pose.dim == 6 else 3)))
    return np.array([where["x"], where["y"]], dtype=np.float64)


def _variances(covariance: FloatArray) -> tuple[float, float]:
    """Variances of translation and rotation, each summed, of a tangent: (x, y, heading), or (rotation, translation)."""
    first, second = (2, 1) if len(covariance) == 3 else (3, 3)
    a, b = float(np.trace(covariance[:first, :first])), float(np.trace(covariance[-second:, -second:]))
    return (a, b) if first == 2 else (b, a)


def _sigma(variances: tuple[FloatArray | float, FloatArray | float], distance: float) -> FloatArray:
    """Standard deviation of a place so far from a pose, m."""
    return np.asarray(np.sqrt(variances[0]) + distance * np.sqrt(variances[1]))

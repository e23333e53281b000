"""Association of observations with the landmarks of the running submap.

Every landmark is compared where both are known best: relative to the pose that it was seen from last. An observation
gives a state of its own, z, by `LandmarkType.initialise`; with its whitened Jacobians A_p, A_l there

    delta = l - z,     S = G P_rel G^T + N + P_l,     G = -A_l^-1 A_p,   N = A_l^-1 A_l^-T

P_rel is the covariance of the motion since the landmark was seen last, P_l what N was then. So no covariance of the
graph is asked for, and a submap far from the start is associated as the first one. A pair is possible inside the
gate and where it is likelier than an observation of a landmark not yet in the map (`log_odds`); the likeliest
assignment is taken, each landmark once.

Walls and lines are finite: two pieces farther apart along the wall than `_GAP` are not of one, though in one plane, as
the fronts of houses in a row are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np

from factors import Vector, pose
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.assignment import assign, gate
from saga_fg.numerics.geometry import carried_covariance, inverse_transform
from saga_fg.slam.mapping.association import log_odds
from saga_fg.slam.mapping.local_map import whitened_jacobians
from saga_fg.types.landmark import LandmarkType, Observation

_GAP = 3.0  # m


@dataclass(eq=False)
class _Known:
    """Landmarks of one kind: number, state, P_l (n, d, d), P_rel (n, 6, 6), and ends (2, 2) seen from above of each."""

    numbers: list[int] = field(default_factory=list)
    states: list[Any] = field(default_factory=list)
    own: list[FloatArray] = field(default_factory=list)
    since: list[FloatArray] = field(default_factory=list)
    ends: list[FloatArray | None] = field(default_factory=list)

    def copy(self) -> _Known:
        return _Known(list(self.numbers), list(self.states), list(self.own), list(self.since), list(self.ends))


class SubmapLandmarks:
    """The landmarks of one submap; probability: of the gates."""

    def __init__(self, probability: float) -> None:
        self._probability = probability
        self._known: dict[LandmarkType, _Known] = {}

    @property
    def numbers(self) -> list[int]:
        """Numbers of all landmarks."""
        return [number for known in self._known.values() for number in known.numbers]

    def copy(self) -> SubmapLandmarks:
        """A copy that further observations can be associated with."""
        twin = SubmapLandmarks(self._probability)
        twin._known = {kind: known.copy() for kind, known in self._known.items()}
        return twin

    def move(self, a_T_b: FloatArray, covariance: FloatArray) -> None:
        """Go on to the next pose: covariance (6, 6) of the motion's tangent."""
        back = inverse_transform(a_T_b)
        for known in self._known.values():
            known.since = list(carried_covariance(back, np.stack(known.since)) + covariance)

    def observe(self, world_T_pose: FloatArray, observations: Sequence[Observation], first: int) -> list[int]:
        """Return the number of the landmark of each observation; new ones are numbered from `first` on."""
        taken = [0] * len(observations)
        for kind in dict.fromkeys(observation.kind for observation in observations):
            rows = [row for row, observation in enumerate(observations) if observation.kind == kind]
            numbers = self._observed(kind, world_T_pose, [observations[row] for row in rows], first)
            for row, number in zip(rows, numbers, strict=True):
                taken[row] = number
            first = max(first, *(number + 1 for number in numbers))
        return taken

    def state(self, number: int) -> Any:
        """The state of a landmark, as it was read last."""
        for known in self._known.values():
            if number in known.numbers:
                return known.states[known.numbers.index(number)]
        raise KeyError(number)

    def read(self, state: Callable[[int], Any]) -> None:
        """Take the states from an estimate."""
        for known in self._known.values():
            known.states = [state(number) for number in known.numbers]

    def _observed(
        self, kind: LandmarkType, world_T_pose: FloatArray, observations: Sequence[Observation], first: int
    ) -> list[int]:
        known, n = self._known.setdefault(kind, _Known()), len(observations)
        observed, R = (np.stack([getattr(z, name) for z in observations]) for name in ("value", "covariance"))
        states = [kind.initialise(world_T_pose, z) for z in observed]
        values = gtsam.Values()
        values.insert(0, pose("world_T_pose", world_T_pose))
        for row, state in enumerate(states):
            values.insert(row + 1, state)
        rows = np.stack([np.zeros(n, dtype=np.int64), np.arange(1, n + 1)], axis=1)
        _, A_p, A_l = whitened_jacobians(kind, rows, observed, R, values)
        root = np.linalg.inv(A_l)
        G, N = -root @ A_p, root @ root.swapaxes(1, 2)
        ends = [_from_above(world_T_pose, one.extent) for one in observations]
        pairs = self._pairs(kind, known, states, G, N, ends)
        numbers = []
        for row, state in enumerate(states):
            if row in pairs:
                j = pairs[row]
                known.own[j], known.since[j] = N[row], np.zeros_like(known.since[j])
                known.ends[j] = _together(known.ends[j], ends[row])
            else:
                j = len(known.numbers)
                known.numbers.append(first)
                known.states.append(state)
                known.own.append(N[row])
                known.ends.append(ends[row])
                known.since.append(np.zeros((A_p.shape[2], A_p.shape[2])))
                first += 1
            numbers.append(known.numbers[j])
        return numbers

    def _pairs(
        self,
        kind: LandmarkType,
        known: _Known,
        states: Sequence[Any],
        G: FloatArray,
        N: FloatArray,
        ends: Sequence[FloatArray | None],
    ) -> dict[int, int]:
        """Rows of matched observations with the rows of their landmarks."""
        if not known.numbers:
            return {}
        d = kind.variable.dim
        delta = _differences(kind, known.states, states)
        S = G[:, None] @ np.stack(known.since) @ G.swapaxes(1, 2)[:, None] + N[:, None] + np.stack(known.own)
        squared = (delta * np.linalg.solve(S, delta[..., None])[..., 0]).sum(axis=2)
        odds = log_odds(squared, np.linalg.slogdet(S)[1], d, kind.density)
        possible = (squared < gate(self._probability, d)) & (odds > 0)
        for row, j in zip(*np.nonzero(possible), strict=True):
            possible[row, j] = _gap(known.ends[j], ends[row]) <= _GAP
        rows, columns = assign(-np.where(possible, odds, 0.0), possible, 0.0)
        return dict(zip(rows.tolist(), columns.tolist(), strict=True))


def _differences(kind: LandmarkType, landmarks: Sequence[Any], states: Sequence[Any]) -> FloatArray:
    """(n, m, d) from each of n states to each of m landmarks."""
    if isinstance(kind.variable, Vector):
        return np.asarray(np.stack(landmarks)[None] - np.stack(states)[:, None])
    return np.array([[kind.variable.local(state, mark) for mark in landmarks] for state in states])


def _from_above(world_T_pose: FloatArray, extent: FloatArray | None) -> FloatArray | None:
    """Ends (2, 2) in the world, from above."""
    return None if extent is None else (extent @ world_T_pose[:3, :3].T + world_T_pose[:3, 3])[:, :2]


def _gap(known: FloatArray | None, seen: FloatArray | None) -> float:
    """Gap between two pieces along the first one, m."""
    if known is None or seen is None:
        return 0.0
    along = _direction(known)
    (low, high), (first, second) = np.sort(known @ along), np.sort(seen @ along)
    return float(max(first - high, low - second, 0.0))


def _together(known: FloatArray | None, seen: FloatArray | None) -> FloatArray | None:
    """The ends of both pieces together, along the first one."""
    if known is None or seen is None:
        return known if seen is None else seen
    every = np.concatenate([known, seen])
    u = every @ _direction(known)
    return every[[int(u.argmin()), int(u.argmax())]]


def _direction(ends: FloatArray) -> FloatArray:
    off = ends[1] - ends[0]
    length = float(np.linalg.norm(off))
    return off / length if length > 0 else np.array([1.0, 0.0])

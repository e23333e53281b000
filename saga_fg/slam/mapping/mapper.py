"""Poses and landmarks in a running graph: their keys, and providers of motions and of associated observations."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from factors import (
    ResidualFactors,
    Robust,
    Solution,
    between_factor,
    pose,
    pose_prior_factor,
)
from saga_fg.estimators import GraphSolution
from saga_fg.graph import EGO_POSE, LANDMARK, Additions, Factor, GraphView, NewVariable, key_of
from saga_fg.numerics import FloatArray
from saga_fg.types import Landmark, LandmarkType, Observation


def pose_key(epoch: int) -> int:
    """Key of the vehicle's pose at an epoch."""
    return key_of(EGO_POSE, 0, epoch)


def landmark_key(number: int) -> int:
    """Key of a landmark."""
    return key_of(LANDMARK, number, None)


@dataclass(frozen=True, eq=False)
class Given:
    """Provider of what is known already."""

    added: Additions
    name: str

    def factors(self, view: GraphView) -> Additions:
        return self.added


@dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """Add the next pose by its measured motion since the one before, a_T_b; the first one by a prior, world_T_pose.

    measured: (d + 1, d + 1); covariance (k, k) of its tangent; start: the pose to begin with, by default as measured
    """

    measured: FloatArray
    covariance: FloatArray
    start: FloatArray | None = None
    name: str = "odometry"

    def factors(self, view: GraphView) -> Additions:
        key, state = pose_key(view.epoch), pose("measured", self.measured)
        if view.epoch == 0:
            factor = pose_prior_factor(key, self.measured, self.covariance)
        else:
            last = pose_key(view.epoch - 1)
            factor, state = between_factor(last, key, self.measured, self.covariance), view.state(last).compose(state)
        if self.start is not None:
            state = pose("start", self.start)
        return Additions([NewVariable(EGO_POSE, 0, state, label="vehicle")], [factor])


@dataclass(frozen=True, eq=False)
class LandmarkObservations:
    """Add associated observations: by epoch, each with the number of its landmark.

    A landmark is added with its first observation, at its state in `start`, or with the last of these epochs if that
    was before; all factors come with the last and under its number, so that those of a kind are linearised together.
    robust: a loss, not for GTSAM's own factors.
    """

    seen: Mapping[int, Sequence[tuple[int, Observation]]]
    start: Mapping[int, Any]
    robust: Robust | None = None
    name: str = "landmarks"

    def factors(self, view: GraphView) -> Additions:
        last = max(self.seen, default=None)
        now = [self.seen.get(view.epoch, ())] if last != view.epoch else self.seen.values()
        kinds = {number: observation.kind for one in now for number, observation in one}
        new = [
            NewVariable(LANDMARK, n, self.start[n], static=True, label=kind.name, type=kind.variable)
            for n, kind in kinds.items()
            if landmark_key(n) not in view.variables
        ]
        return Additions(new, named={last: observation_factors(self.seen, self.robust)} if last == view.epoch else {})

    def landmarks(self, solution: Solution | GraphSolution, confirm: int = 1) -> list[Landmark]:
        """The landmarks by number, where a solution has them; confirm: observations that make one certain."""
        kinds, counts = dict[int, LandmarkType](), Counter[int]()
        for number, observation in (one for now in self.seen.values() for one in now):
            kinds[number] = observation.kind
            counts[number] += 1
        found = []
        for n, kind in sorted(kinds.items()):
            state, covariance = kind.variable.read(solution.values, landmark_key(n)), solution.marginal(landmark_key(n))
            found.append(Landmark(n, kind, state, covariance, counts[n], counts[n] >= confirm))
        return found


def observation_factors(
    seen: Mapping[int, Sequence[tuple[int, Observation]]], robust: Robust | None = None
) -> list[Factor]:
    """The factors of observations as in `LandmarkObservations`, those of a kind together."""
    by_kind: dict[LandmarkType, list[tuple[list[int], Observation]]] = {}
    for epoch, now in seen.items():
        for number, observation in now:
            row = [pose_key(epoch), landmark_key(number)]
            by_kind.setdefault(observation.kind, []).append((row, observation))
    factors: list[Factor] = []
    for kind, alike in by_kind.items():
        rows = np.array([row for row, _ in alike], dtype=np.int64)
        observed, covariances = (np.stack([getattr(z, name) for _, z in alike]) for name in ("value", "covariance"))
        factors += kind.factors(rows, observed, covariances)
    if robust is None:
        return factors
    return [replace(one, robust=robust) if isinstance(one, ResidualFactors) else one for one in factors]


@dataclass(frozen=True, eq=False)
class AssociatedObservation:
    """An observation with the row of its pose and the number of the landmark that it was associated with."""

    pose: int
    observation: Observation
    landmark: int

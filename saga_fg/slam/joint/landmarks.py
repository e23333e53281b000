"""Association of landmarks of unknown identity, along a path and online.

Along a path assumed so far an observation belongs to the nearest landmark of its kind, by its last observation, within
`reach`, else to a new one: a pose drifts little between two views of one thing, and association is repeated along the
path found. Online the joint Gaussian of the new pose and the landmarks of the window that can be seen from it decides
(`saga_fg.slam.mapping.associate`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np

from saga_fg.estimators.graph_solution import GraphSolution
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.mapping import (
    LandmarkObservations,
    LandmarkSettings,
    LocalMap,
    NearbyLandmarks,
    associate,
    landmark_key,
    place_of,
    pose_key,
)
from saga_fg.types.landmark import Landmark, LandmarkType, Observation

Observations = Sequence[Sequence[Observation]]


def nearest_landmarks(observations: Observations, path: FloatArray, reach: float) -> LandmarkObservations:
    """Associate the observations of n epochs along a path (n, 4, 4); reach in m."""
    start: dict[int, Any] = {}
    places: dict[LandmarkType, dict[int, FloatArray]] = {}
    seen: dict[int, list[tuple[int, Observation]]] = {}
    for epoch, (now, pose) in enumerate(zip(observations, path, strict=True)):
        for observation in now:
            state = observation.kind.initialise(pose, observation.value)
            where = observation.kind.coordinates(state)
            place = np.array([where["x"], where["y"]])
            known = places.setdefault(observation.kind, {})
            distance = {number: float(np.linalg.norm(there - place)) for number, there in known.items()}
            number = min(distance, key=distance.__getitem__, default=len(start))
            if distance.get(number, np.inf) > reach:
                number = len(start)
                start[number] = state
            known[number] = place
            seen.setdefault(epoch, []).append((number, observation))
    return LandmarkObservations(seen, start)


class WindowLandmarks:
    """Landmarks of an online estimator: those observed in the window, and those that left it, in their last state."""

    def __init__(self, settings: LandmarkSettings) -> None:
        self._settings = settings
        self._last_seen: dict[int, int] = {}
        self._kinds: dict[int, LandmarkType] = {}
        self._count: dict[int, int] = {}
        self._gone: dict[int, Landmark] = {}
        self._near = NearbyLandmarks(by_odometry=False)

    def observe(self, k: int, solution: GraphSolution, observations: Sequence[Observation]) -> LandmarkObservations:
        """Associate observations from the epoch k; one without a match initiates a new landmark."""
        places = [place_of(observation) for observation in observations]
        pose, covariance = solution.values.atPose3(pose_key(k)).matrix(), solution.marginal(pose_key(k))
        numbers = self._near.near(pose[:2, 3], covariance).tolist()
        P = solution.covariance([pose_key(k), *map(landmark_key, numbers)])
        states = {n: (self._kinds[n], self._state(n, solution.values)) for n in numbers}
        pairs = associate(LocalMap(pose, P, states), observations, self._settings.gate)
        start: dict[int, object] = {}
        seen: list[tuple[int, Observation]] = []
        for row, observation in enumerate(observations):
            if row in pairs:
                number = pairs[row].landmark
            else:
                number = len(self._count) + 1
                self._kinds[number] = observation.kind
                start[number] = observation.kind.initialise(pose, observation.value)
            self._count[number] = self._count.get(number, 0) + 1
            self._last_seen[number] = k
            self._near.see(number, places[row], pose, covariance)
            seen.append((number, observation))
        return LandmarkObservations({k: seen}, start)

    def forget(self, first: int, solution: GraphSolution) -> list[int]:
        """Let landmarks leave that were last observed before the epoch `first`; returns their keys."""
        gone = [number for number in self._kinds if self._last_seen[number] < first]
        for number in gone:
            self._gone[number] = self._landmark(number, solution)
            del self._kinds[number]
        self._near.forget(gone)
        return [landmark_key(number) for number in gone]

    def all(self, solution: GraphSolution | None) -> list[Landmark]:
        """All so far: those in the window, and others in their last state."""
        current = [] if solution is None else [self._landmark(number, solution) for number in self._kinds]
        return sorted([*self._gone.values(), *current], key=lambda mark: mark.number)

    def _landmark(self, number: int, solution: GraphSolution) -> Landmark:
        covariance = solution.covariance([landmark_key(number)])
        count = self._count[number]
        state = self._state(number, solution.values)
        return Landmark(number, self._kinds[number], state, covariance, count, count >= self._settings.confirm_after)

    def _state(self, number: int, values: gtsam.Values) -> object:
        return self._kinds[number].variable.read(values, landmark_key(number))

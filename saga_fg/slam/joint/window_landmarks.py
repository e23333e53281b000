"""Landmarks of an online estimator's window: told apart by the joint Gaussian of the new pose and the landmarks."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam

from saga_fg.estimators.graph_solution import GraphSolution
from saga_fg.slam.mapping import EkfSlam, LandmarkObservations, MapperSettings, associate, landmark_key, pose_key
from saga_fg.types.landmark import Landmark, LandmarkType, Observation


class WindowLandmarks:
    """Which were seen from the moments of the window, and how those were when they left it that are seen no more."""

    def __init__(self, settings: MapperSettings) -> None:
        self._settings = settings
        self._last_seen: dict[int, int] = {}
        self._kinds: dict[int, LandmarkType] = {}
        self._count: dict[int, int] = {}
        self._gone: dict[int, Landmark] = {}

    def observe(self, k: int, solution: GraphSolution, observations: Sequence[Observation]) -> LandmarkObservations:
        """Tell which landmark each observation from the moment k is of; what is of none begins one."""
        numbers = sorted(self._kinds)
        P = solution.covariance([pose_key(k), *map(landmark_key, numbers)])
        states = {n: (self._kinds[n], self._state(n, solution.values)) for n in numbers}
        pose = solution.values.atPose3(pose_key(k)).matrix()
        pairs = associate(EkfSlam(pose, P, states), observations, self._settings.gate)
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
            seen.append((number, observation))
        return LandmarkObservations({k: seen}, start)

    def leave(self, first: int, solution: GraphSolution) -> list[int]:
        """Forget what was seen before the moment `first`; returns the keys of the landmarks that are seen no more."""
        gone = [number for number in self._kinds if self._last_seen[number] < first]
        for number in gone:
            self._gone[number] = self._landmark(number, solution)
            del self._kinds[number]
        return [landmark_key(number) for number in gone]

    def all(self, solution: GraphSolution | None) -> list[Landmark]:
        """All so far: those in the window as they are, others as they were when they left it."""
        current = [] if solution is None else [self._landmark(number, solution) for number in self._kinds]
        return sorted([*self._gone.values(), *current], key=lambda mark: mark.number)

    def _landmark(self, number: int, solution: GraphSolution) -> Landmark:
        covariance = solution.covariance([landmark_key(number)])
        count = self._count[number]
        state = self._state(number, solution.values)
        return Landmark(number, self._kinds[number], state, covariance, count, count >= self._settings.confirm)

    def _state(self, number: int, values: gtsam.Values) -> object:
        return self._kinds[number].variable.read(values, landmark_key(number))

"""Landmarks of an online estimator's window: told apart by the joint Gaussian of the new pose and the landmarks."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam

from saga_fg.ego.graph import pose_key
from saga_fg.ego.landmarks import landmark_key
from saga_fg.estimators.graph_solution import GraphSolution
from saga_fg.graph import LANDMARK, Additions, GraphView, NewVariable
from saga_fg.landmarks import JointEstimate as LandmarkEstimate
from saga_fg.landmarks import Landmark, LandmarkType, MapperSettings, Observation, associate, sighting_factors


class WindowLandmarks:
    """Which were seen from the moments of the window, and how those were when they left it that are seen no more."""

    name = "landmarks"

    def __init__(self, settings: MapperSettings) -> None:
        self._settings = settings
        self._new = Additions()
        self._sightings: list[tuple[int, int, Observation]] = []
        self._kinds: dict[int, LandmarkType] = {}
        self._count: dict[int, int] = {}
        self._gone: dict[int, Landmark] = {}

    def factors(self, view: GraphView) -> Additions:
        """New landmarks and the sightings of the newest moment, both as last observed."""
        return self._new

    def observe(self, k: int, solution: GraphSolution, observations: Sequence[Observation]) -> None:
        """Tell which landmark each observation from the moment k is of; what is of none begins one."""
        numbers = sorted(self._kinds)
        P = solution.covariance([pose_key(k), *map(landmark_key, numbers)])
        states = {n: (self._kinds[n], self._state(n, solution.values)) for n in numbers}
        pose = solution.values.atPose3(pose_key(k)).matrix()
        pairs = associate(LandmarkEstimate.of(pose, states, P), observations, self._settings.gate)
        begun, seen = [], []
        for row, observation in enumerate(observations):
            if row in pairs:
                number = pairs[row].landmark
            else:
                number, kind = len(self._count) + 1, observation.kind
                self._kinds[number] = kind
                state = kind.initialise(pose, observation.value)
                begun.append(NewVariable(LANDMARK, number, state, static=True, label=kind.name, type=kind.variable))
            self._count[number] = self._count.get(number, 0) + 1
            seen.append((k, number, observation))
        self._sightings += seen
        native, ours = sighting_factors((pose_key(k), landmark_key(n), z) for k, n, z in seen)
        self._new = Additions(begun, [native, *ours])

    def leave(self, first: int, solution: GraphSolution) -> list[int]:
        """Forget what was seen before the moment `first`; returns the keys of the landmarks that are seen no more."""
        self._sightings = [sighting for sighting in self._sightings if sighting[0] >= first]
        still_seen = {number for _, number, _ in self._sightings}
        gone = [number for number in self._kinds if number not in still_seen]
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

"""Landmarks of an online estimator's window: told apart by the joint Gaussian of the new pose and the landmarks."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam

from factors import Linearisable, Solution, marginal_moments
from saga_fg.ego.graph import pose_key
from saga_fg.ego.landmarks import landmark_key
from saga_fg.ego.window import Window
from saga_fg.landmarks import JointEstimate as LandmarkEstimate
from saga_fg.landmarks import Landmark, LandmarkType, MapperSettings, Observation, associate, sighting_factors


class WindowLandmarks:
    """Which were seen from the moments of the window, and how those were when they left it that are seen no more."""

    def __init__(self, settings: MapperSettings) -> None:
        self._settings = settings
        self._sightings: list[tuple[int, int, Observation]] = []
        self._kinds: dict[int, LandmarkType] = {}
        self._count: dict[int, int] = {}
        self._gone: dict[int, Landmark] = {}

    def factors(self) -> tuple[gtsam.NonlinearFactorGraph, list[Linearisable]]:
        """Native factors of all sightings in the window, and our own."""
        return sighting_factors((pose_key(k), landmark_key(n), z) for k, n, z in self._sightings)

    def observe(self, k: int, window: Window, solution: Solution, observations: Sequence[Observation]) -> None:
        """Tell which landmark each observation from the moment k is of; what is of none begins one."""
        numbers = sorted(self._kinds)
        _, P = marginal_moments(solution.linear, [pose_key(k), *map(landmark_key, numbers)], "qr")
        states = {n: (self._kinds[n], self._state(n, window.values)) for n in numbers}
        pose = window.values.atPose3(pose_key(k)).matrix()
        pairs = associate(LandmarkEstimate.of(pose, states, P), observations, self._settings.gate)
        for row, observation in enumerate(observations):
            if row in pairs:
                number = pairs[row].landmark
            else:
                number = len(self._count) + 1
                self._kinds[number] = observation.kind
                window.values.insert(landmark_key(number), observation.kind.initialise(pose, observation.value))
            self._count[number] = self._count.get(number, 0) + 1
            self._sightings.append((k, number, observation))

    def leave(self, first: int, solution: Solution) -> list[int]:
        """Forget what was seen before the moment `first`; returns the keys of the landmarks that are seen no more."""
        self._sightings = [sighting for sighting in self._sightings if sighting[0] >= first]
        still_seen = {number for _, number, _ in self._sightings}
        gone = [number for number in self._kinds if number not in still_seen]
        for number in gone:
            self._gone[number] = self._landmark(number, solution)
            del self._kinds[number]
        return [landmark_key(number) for number in gone]

    def all(self, solution: Solution | None) -> list[Landmark]:
        """All so far: those in the window as they are, others as they were when they left it."""
        current = [] if solution is None else [self._landmark(number, solution) for number in self._kinds]
        return sorted([*self._gone.values(), *current], key=lambda mark: mark.number)

    def _landmark(self, number: int, solution: Solution) -> Landmark:
        covariance = marginal_moments(solution.linear, [landmark_key(number)], "qr")[1]
        count = self._count[number]
        state = self._state(number, solution.values)
        return Landmark(number, self._kinds[number], state, covariance, count, count >= self._settings.confirm)

    def _state(self, number: int, values: gtsam.Values) -> object:
        return self._kinds[number].variable.read(values, landmark_key(number))

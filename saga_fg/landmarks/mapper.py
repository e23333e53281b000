"""SLAM with landmarks whose identities nobody tells: online, with everything smoothed again from time to time.

Between two smoothings the pose and the landmarks are one Gaussian (`JointEstimate`), which is what gates need: the
innovation of an observation takes the correlation of pose and landmark into account. Everything is kept as factors,
and every `smooth_every` observations the whole graph is solved anew from where it stood, so that linearisation errors
do not add up; the joint marginal of the newest pose and all landmarks then replaces the Gaussian. At the same time
landmarks that turn out to be one are merged (see `merging`).

How far odometry and sensor are to be believed is itself a hypothesis, and the probability of all that was measured says
which is the better one, without any truth (Laplace's approximation at the solution x* with information matrix H):

    log p(z) = -E(x*) - 1/2 log det H + D/2 log 2 pi - 1/2 sum_i log det 2 pi R_i + sum_landmarks log density
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from factors import (
    Linearisable,
    SolverSettings,
    between_factor,
    marginal_moments,
    pose,
    pose_prior_factor,
    solve,
)
from saga_fg.arrays import FloatArray
from saga_fg.landmarks.association import associate
from saga_fg.landmarks.factors import sighting_factors
from saga_fg.landmarks.joint_estimate import JointEstimate
from saga_fg.landmarks.merging import duplicates
from saga_fg.landmarks.protocol import LandmarkType, Observation
from saga_fg.settings import require_between, setting

_SOLVER = SolverSettings(tolerance=1e-2, max_iterations=20)


@dataclass(frozen=True)
class MapperSettings:
    """How landmarks are told apart."""

    gate: float = setting(0.999, "share of the true pairs that the gate of association lets through")
    merge: float = setting(1 - 1e-6, "the same of merging; near to 1, as what begins a duplicate is an outlier")
    smooth_every: int = setting(100, "observations between two smoothings of the whole graph")
    confirm: int = setting(2, "observations that make a landmark certain")

    def __post_init__(self) -> None:
        require_between(self, 0.5, 1 - 1e-9, "gate", "merge")
        require_between(self, 1, 10**9, "smooth_every", "confirm")


@dataclass(frozen=True, eq=False)
class Sighting:
    """What was observed from which pose, and the number of the landmark it was taken for."""

    pose: int
    observation: Observation
    landmark: int


@dataclass(frozen=True, eq=False)
class Landmark:
    """A landmark of the map: its state, the covariance (d, d) of that, and how often it was seen."""

    number: int
    kind: LandmarkType
    state: Any
    covariance: FloatArray
    sightings: int
    confirmed: bool


@dataclass(frozen=True, eq=False)
class LandmarkMap:
    """world_T_pose: (N, d + 1, d + 1); landmarks in the order of their numbers; sightings in the order they came."""

    world_T_pose: FloatArray
    landmarks: list[Landmark]
    sightings: list[Sighting]


class LandmarkMapper:
    """Builds a map from odometry and observations, one pose after the other.

    mapper = LandmarkMapper(np.eye(3), 1e-6 * np.eye(3))
    mapper.observe([Observation(PointLandmark(), [9.0, 2.0], R)])
    mapper.move(a_T_b, Q)
    ...
    landmark_map = mapper.map()
    """

    def __init__(
        self, world_T_pose: FloatArray, covariance: FloatArray, settings: MapperSettings | None = None
    ) -> None:
        """world_T_pose: the first pose, (3, 3) in the plane or (4, 4); covariance: of its tangent."""
        self.settings = settings or MapperSettings()
        self.estimate = JointEstimate(world_T_pose, covariance)
        self._native = gtsam.NonlinearFactorGraph()
        self._native.add(pose_prior_factor(_pose_key(0), world_T_pose, covariance))
        self._values = gtsam.Values()
        self._values.insert(_pose_key(0), pose("world_T_pose", world_T_pose))
        self._poses = 1
        self._sightings: list[Sighting] = []
        self._numbers = 0
        self._since = 0
        self._normaliser = _log_det(covariance)

    def move(self, a_T_b: FloatArray, covariance: FloatArray) -> None:
        """Go on to the next pose by odometry: a_T_b (d + 1, d + 1), covariance of its tangent."""
        self._native.add(between_factor(_pose_key(self._poses - 1), _pose_key(self._poses), a_T_b, covariance))
        self.estimate.move(a_T_b, covariance)
        self._normaliser += _log_det(covariance)
        self._values.insert(_pose_key(self._poses), self.estimate.pose)
        self._poses += 1

    def observe(self, observations: Sequence[Observation]) -> list[int]:
        """Take in what is seen from the present pose.

        Returns the number of the landmark of each; what is not surely a known one begins a new one.
        """
        pairs = associate(self.estimate, observations, self.settings.gate)
        if pairs:
            self.estimate.update(list(pairs.values()))
        taken: list[int] = []
        for row, observation in enumerate(observations):
            if row in pairs:
                taken.append(pairs[row].landmark)
                continue
            self._numbers += 1
            self.estimate.append(self._numbers, observation)
            self._values.insert(_landmark_key(self._numbers), self.estimate.state(self._numbers))
            taken.append(self._numbers)
        self._sightings += [
            Sighting(self._poses - 1, observation, number)
            for observation, number in zip(observations, taken, strict=True)
        ]
        self._normaliser += sum(_log_det(observation.covariance) for observation in observations)
        self._since += len(observations)
        if self._since >= self.settings.smooth_every:
            self.smooth()
        return taken

    def smooth(self) -> None:
        """Solve for all poses and landmarks, and merge what turns out to be one."""
        self._since = 0
        self._solve()
        while merged := duplicates(self.estimate, self.settings.merge, self._apart()):
            self._sightings = [replace(s, landmark=merged.get(s.landmark, s.landmark)) for s in self._sightings]
            for number in merged:
                self._values.erase(_landmark_key(number))
            self._solve()

    def log_evidence(self) -> float:
        """log p(z) of everything measured so far, smoothed."""
        self.smooth()
        graph, factors = self._graph()
        solution = solve(graph, factors, self._values, _SOLVER)
        half_log_det = float(solution.linear.eliminateMultifrontal().logDeterminant())
        free = sum(self._values.dims().values())
        expected = sum(float(np.log(kind.density)) for kind in self.estimate.kinds.values())
        volume = 0.5 * free * float(np.log(2 * np.pi))
        return -solution.error - half_log_det + volume - 0.5 * self._normaliser + expected

    def map(self) -> LandmarkMap:
        """Everything, smoothed."""
        self.smooth()
        seen = [s.landmark for s in self._sightings]
        landmarks = [
            Landmark(
                number,
                kind,
                self.estimate.state(number),
                self.estimate.covariance([number]),
                seen.count(number),
                seen.count(number) >= self.settings.confirm,
            )
            for number, kind in sorted(self.estimate.kinds.items())
        ]
        at = self._values.atPose2 if self.estimate.planar else self._values.atPose3
        poses = np.stack([at(_pose_key(i)).matrix() for i in range(self._poses)])
        return LandmarkMap(poses, landmarks, list(self._sightings))

    def _solve(self) -> None:
        graph, factors = self._graph()
        solution = solve(graph, factors, self._values, _SOLVER)
        self._values = solution.values
        kinds = {s.landmark: s.observation.kind for s in self._sightings}
        numbers = sorted(kinds)
        keys = [_pose_key(self._poses - 1), *map(_landmark_key, numbers)]
        _, covariance = marginal_moments(solution.linear, keys)
        at = self._values.atPose2 if self.estimate.planar else self._values.atPose3
        states = {
            number: (kinds[number], kinds[number].variable.read(self._values, _landmark_key(number)))
            for number in numbers
        }
        self.estimate = JointEstimate.of(at(keys[0]).matrix(), states, covariance)

    def _graph(self) -> tuple[gtsam.NonlinearFactorGraph, list[Linearisable]]:
        graph = self._native.clone()
        seen, factors = sighting_factors(
            (_pose_key(s.pose), _landmark_key(s.landmark), s.observation) for s in self._sightings
        )
        graph.push_back(seen)
        return graph, factors

    def _apart(self) -> set[tuple[int, int]]:
        """Pairs of landmarks that were seen from one pose."""
        seen: dict[int, set[int]] = {}
        for sighting in self._sightings:
            seen.setdefault(sighting.pose, set()).add(sighting.landmark)
        return {(i, j) for together in seen.values() for i in together for j in together if i < j}


def _log_det(covariance: FloatArray) -> float:
    return float(np.linalg.slogdet(2 * np.pi * np.asarray(covariance))[1])


def _pose_key(index: int) -> int:
    return int(gtsam.symbol("x", index))


def _landmark_key(number: int) -> int:
    return int(gtsam.symbol("l", number))

"""Online SLAM with landmarks of unknown identity, smoothed from time to time.

Between two smoothings the pose and the landmarks are one Gaussian (`EkfSlam`), whose correlations the gates of
association need. Every `smooth_every` observations all measurements since then go into a running graph
(`saga_fg.graph`), which iSAM2 keeps smoothed, so that linearisation errors do not add up; the joint marginal of the
newest pose and all landmarks then replaces the Gaussian, and duplicate landmarks are merged (see `merging`).

The evidence of the measurements compares noise models of odometry and sensor without ground truth (Laplace's
approximation at the solution x* with information matrix H):

    log p(z) = -E(x*) - 1/2 log det H + D/2 log 2 pi - 1/2 sum_i log det 2 pi R_i + sum_landmarks log density
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import numpy as np

from factors import ResidualFactor, SolverSettings, Variable
from saga_fg.estimators.batch_solver import BatchSolver
from saga_fg.estimators.incremental_smoother import IncrementalSmoother
from saga_fg.estimators.isam2_engine import RelinearisationSettings
from saga_fg.graph import Additions, GraphView
from saga_fg.numerics.arrays import FloatArray
from saga_fg.settings import Range, Settings, setting
from saga_fg.slam.mapping.association import associate
from saga_fg.slam.mapping.ekf_slam import EkfSlam
from saga_fg.slam.mapping.merging import duplicates
from saga_fg.slam.mapping.providers import (
    LandmarkObservations,
    MeasuredMotion,
    landmark_key,
    observation_factors,
    pose_key,
)
from saga_fg.types.landmark import Landmark, Observation

_MERGE_GATE = 1 - 1e-6  # gate probability of merging duplicates; near 1, since an outlier starts a duplicate
_THRESHOLD = 1.0  # standard deviations that a variable moves before its factors are linearised anew
_SOLVER = SolverSettings(tolerance=1e-2, max_iterations=20)


@dataclass(frozen=True)
class MapperSettings(Settings):
    """Association, merging and confirmation of landmarks."""

    gate: Annotated[float, Range(0.5, 1 - 1e-09)] = setting(
        0.999, "gate probability of association; higher: fewer duplicates, more wrong matches"
    )
    smooth_every: Annotated[int, Range(1, 10**9)] = setting(
        100, "observations between two smoothings of the whole graph; higher: faster, later corrections"
    )
    confirm_after: Annotated[int, Range(1, 10**9)] = setting(2, "observations that confirm a landmark")


@dataclass(frozen=True, eq=False)
class AssociatedObservation:
    """An observation with the row of its pose and the number of the landmark that it was associated with."""

    pose: int
    observation: Observation
    landmark: int


@dataclass(frozen=True, eq=False)
class LandmarkMap:
    """world_T_pose: (N, d + 1, d + 1); landmarks in the order of their numbers; observations in the order they came."""

    world_T_pose: FloatArray
    landmarks: list[Landmark]
    observations: list[AssociatedObservation]


class LandmarkMapper:
    """Build a map from odometry and observations, one pose after the other.

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
        self.ekf = EkfSlam(world_T_pose, covariance)
        self._smoother = IncrementalSmoother(lag=None, settings=RelinearisationSettings(_THRESHOLD))
        self._poses = 1
        self._waiting = [MeasuredMotion(world_T_pose, covariance)]
        self._seen: dict[int, list[tuple[int, Observation]]] = {}  # since the last smoothing, by pose
        self._smoothed: dict[int, dict[int, list[tuple[int, Observation]]]] = {}  # by the last pose of a smoothing
        self._numbers = 0
        self._since = 0
        self._normaliser = _log_det(covariance)

    def move(self, a_T_b: FloatArray, covariance: FloatArray) -> None:
        """Go on to the next pose by odometry: a_T_b (d + 1, d + 1), covariance of its tangent."""
        self.ekf.predict(a_T_b, covariance)
        self._waiting.append(MeasuredMotion(a_T_b, covariance, self.ekf.pose.matrix()))
        self._normaliser += _log_det(covariance)
        self._poses += 1

    def observe(self, observations: Sequence[Observation]) -> list[int]:
        """Add observations from the present pose.

        Returns the number of the landmark of each; an observation without a clear match initiates a new landmark.
        """
        pairs = associate(self.ekf, observations, self.settings.gate)
        if pairs:
            self.ekf.update(list(pairs.values()))
        taken: list[int] = []
        for row, observation in enumerate(observations):
            if row in pairs:
                taken.append(pairs[row].landmark)
                continue
            self._numbers += 1
            self.ekf.augment(self._numbers, observation)
            taken.append(self._numbers)
        self._seen.setdefault(self._poses - 1, []).extend(zip(taken, observations, strict=True))
        self._normaliser += sum(_log_det(observation.covariance) for observation in observations)
        self._since += len(observations)
        if self._since >= self.settings.smooth_every:
            self.smooth()
        return taken

    def smooth(self) -> None:
        """Smooth all poses and landmarks, and merge duplicates."""
        self._since = 0
        if self._waiting or self._seen:
            last = self._poses - 1
            chunk = {row: list(now) for row, now in self._smoothed.get(last, {}).items()}
            for row, now in [*self._seen.items(), (last, [])]:
                chunk.setdefault(row, []).extend(now)
            observations = LandmarkObservations(chunk, {n: self.ekf.state(n) for now in chunk.values() for n, _ in now})
            first = self._poses - len(self._waiting)
            if self._waiting:
                self._smoother.steps([(float(first + k), [one, observations]) for k, one in enumerate(self._waiting)])
            else:
                self._smoother.extend([observations])
            self._smoothed[last] = chunk
            self._waiting, self._seen = [], {}
            self._read()
        while merged := duplicates(self.ekf, _MERGE_GATE, self._seen_together()):
            changed = {
                last: {row: [(merged.get(n, n), z) for n, z in now] for row, now in chunk.items()}
                for last, chunk in self._smoothed.items()
                if any(n in merged for now in chunk.values() for n, _ in now)
            }
            self._smoothed |= changed
            self._smoother.extend([_Merged(changed, {n: self.ekf.kinds[n].variable for n in merged})])
            self._smoother.marginalise(map(landmark_key, merged))
            for number in merged:
                del self.ekf.kinds[number]
            self._read()

    def log_evidence(self) -> float:
        """log p(z) of all measurements so far, smoothed."""
        self.smooth()
        solution = self._smoother.snapshot().solve(_SOLVER)
        half_log_det = float(solution.linear.eliminateMultifrontal().logDeterminant())
        free = sum(solution.values.dims().values())
        expected = sum(float(np.log(kind.density)) for kind in self.ekf.kinds.values())
        volume = 0.5 * free * float(np.log(2 * np.pi))
        return -solution.error - half_log_det + volume - 0.5 * self._normaliser + expected

    def map(self) -> LandmarkMap:
        """All poses and landmarks, smoothed."""
        self.smooth()
        solver = BatchSolver(graph=self._smoother.snapshot(), settings=_SOLVER)
        seen = {row: now for chunk in self._smoothed.values() for row, now in chunk.items()}
        observations = [
            AssociatedObservation(row, observation, number) for row, now in seen.items() for number, observation in now
        ]
        poses = np.stack([_pose(solver, row) for row in range(self._poses)])
        return LandmarkMap(
            poses, LandmarkObservations(seen, {}).landmarks(solver.solve(), self.settings.confirm_after), observations
        )

    def _read(self) -> None:
        """Replace the Gaussian by the joint marginal of the graph."""
        numbers = sorted(self.ekf.kinds)
        keys = [pose_key(self._poses - 1), *map(landmark_key, numbers)]
        landmarks = {n: (self.ekf.kinds[n], self._smoother.state(landmark_key(n))) for n in numbers}
        P = self._smoother.joint_covariance(keys, rough=True)
        self.ekf = EkfSlam(_pose(self._smoother, self._poses - 1), P, landmarks)

    def _seen_together(self) -> set[tuple[int, int]]:
        """Pairs of landmarks that were seen from one pose."""
        together = ({n for n, _ in now} for chunk in self._smoothed.values() for now in chunk.values())
        return {(i, j) for numbers in together for i in numbers for j in numbers if i < j}


@dataclass(frozen=True, eq=False)
class _Merged:
    """Observations under the numbers of merged landmarks; the old landmarks are held until they are marginalised."""

    changed: Mapping[int, Mapping[int, Sequence[tuple[int, Observation]]]]
    old: Mapping[int, Variable]
    name: str = LandmarkObservations.name

    def factors(self, view: GraphView) -> Additions:
        held = []
        for number, variable in self.old.items():
            key = landmark_key(number)
            off = partial(variable.local, view.state(key))
            held.append(ResidualFactor((key,), (variable,), off, np.eye(variable.dim), name="held"))
        return Additions(factors=held, named={last: observation_factors(chunk) for last, chunk in self.changed.items()})


def _pose(solver: IncrementalSmoother | BatchSolver, row: int) -> FloatArray:
    pose: Any = solver.state(pose_key(row))
    return np.asarray(pose.matrix())


def _log_det(covariance: FloatArray) -> float:
    return float(np.linalg.slogdet(2 * np.pi * np.asarray(covariance))[1])

"""Online SLAM with landmarks of unknown identity, whose cost for a pose does not grow with the map.

Between two smoothings the pose and the landmarks near it are one Gaussian (`LocalMap`), whose correlations the gates of
association need. Every `smooth_every` observations, or where the vehicle comes near landmarks that it does not hold,
all measurements since then go into a running graph (`saga_fg.graph`), which iSAM2 keeps smoothed, so that linearisation
errors do not add up; the joint marginal of the newest pose and the landmarks near it (`NearbyLandmarks`) then replaces
the Gaussian. Duplicates among them are merged (`benchmarks.landmark_merging`), and then those along the way on which
the merged ones were seen.

The evidence of the measurements compares noise models of odometry and sensor without ground truth (Laplace's
approximation at the solution x* with information matrix H):

    log p(z) = -E(x*) - 1/2 log det H + D/2 log 2 pi - 1/2 sum_i log det 2 pi R_i + sum_landmarks log density
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np

from benchmarks.landmark_merging import NearbyLandmarks, duplicates, place_of
from factors import FactorError, SolverSettings, Variable, pose, residual_factor
from saga_fg.errors import InputError, require_type
from saga_fg.estimators import BatchSolver, IncrementalSmoother, RelinearisationSettings
from saga_fg.graph import Additions, GraphView
from saga_fg.numerics import FloatArray, checked_covariances
from saga_fg.settings import Range, Settings, setting
from saga_fg.slam.mapping import (
    AssociatedObservation,
    LandmarkObservations,
    LocalMap,
    MeasuredMotion,
    associate,
    landmark_key,
    pose_key,
)
from saga_fg.slam.mapping.local_map import POSE
from saga_fg.slam.mapping.mapper import observation_factors
from saga_fg.types import Landmark, LandmarkType, Observation

_MERGE_GATE = 1 - 1e-6  # gate probability of merging duplicates; near 1, since an outlier starts a duplicate
_THRESHOLD = 1.0  # standard deviations that a variable moves before its factors are linearised anew
_WILDFIRE = 1e-5  # m and rad; changes that are passed on through the graph, online
_SOLVER = SolverSettings(tolerance=1e-2, max_iterations=20)


@dataclass(frozen=True)
class MapperSettings(Settings):
    """Confirmation and smoothing of landmarks."""

    confirm_after: Annotated[int, Range(1, 10**9)] = setting(2, "observations that confirm a landmark")
    smooth_every: Annotated[int, Range(1, 10**9)] = setting(
        100, "largest number of observations between two smoothings; higher: faster, later corrections"
    )


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
        """world_T_pose: the first pose, (3, 3) in the plane or (4, 4); covariance: of its tangent.

        Raises `InputError` for what is no pose, or no positive definite covariance of one.
        """
        self.settings = settings or MapperSettings()
        world_T_pose = _rigid("world_T_pose", world_T_pose)
        covariance = checked_covariances("covariance", [covariance], 1, 3 if len(world_T_pose) == 3 else 6)[0]
        self.local = LocalMap(world_T_pose, covariance)
        self._smoother = IncrementalSmoother(
            lag=None, settings=RelinearisationSettings(_THRESHOLD, wildfire=_WILDFIRE), elimination="cholesky"
        )
        self._poses = 1
        self._near = NearbyLandmarks()
        self._centre = self._place()  # that the landmarks in `local` are near to
        self._time = 0.0  # of the present pose, s
        self._waiting = [(0.0, MeasuredMotion(world_T_pose, covariance))]
        self._seen: dict[int, list[tuple[int, Observation]]] = {}  # since the last smoothing, by pose
        self._smoothed: dict[int, dict[int, list[tuple[int, Observation]]]] = {}  # by the last pose of a smoothing
        self._kinds: dict[int, LandmarkType] = {}  # of all landmarks
        self._smoothings: dict[int, set[int]] = {}  # that brought observations of each landmark, by their last poses
        self._together: dict[int, set[int]] = {}  # others that were seen from one pose with each landmark
        self._here = set[int]()  # seen from the present pose
        self._numbers = 0
        self._since = 0
        self._normaliser = _log_det(covariance)

    @property
    def landmarks(self) -> Mapping[int, LandmarkType]:
        """The types of all landmarks so far, by number."""
        return MappingProxyType(self._kinds)

    def move(self, a_T_b: FloatArray, covariance: FloatArray, time: float | None = None) -> None:
        """Go on to the next pose by odometry: a_T_b (d + 1, d + 1), covariance of its tangent.

        time: s, by default one second after the last pose; messages name it. Raises `InputError` for what is no motion.
        """
        time = self._time + 1.0 if time is None else float(time)
        if not self._time < time < np.inf:
            raise InputError(f"time: expected a finite number after {self._time:.6f} s, got {time!r}")
        a_T_b = _rigid("a_T_b", a_T_b, 3 if self.local.planar else 4)
        covariance = checked_covariances("covariance", [covariance], 1, 3 if self.local.planar else 6)[0]
        self.local.predict(a_T_b, covariance)
        self._near.move(a_T_b, covariance)
        self._waiting.append((time, MeasuredMotion(a_T_b, covariance, self.local.pose.matrix())))
        self._normaliser += _log_det(covariance)
        self._poses, self._time = self._poses + 1, time
        self._here = set()

    def observe(self, observations: Sequence[Observation]) -> list[int]:
        """Add observations from the present pose.

        Returns the number of the landmark of each; an observation without a clear match initiates a new landmark.
        Raises `InputError`, and adds none, for one that its type refuses, or that does not determine a new landmark.
        """
        require_type("observations", observations, Sequence)
        try:
            for observation in observations:
                self._check(observation)
            places = [place_of(observation) for observation in observations]
            self._come_near()
            pairs = associate(self.local, observations)
            for row, observation in enumerate(observations):
                if row not in pairs:
                    self.local.check(observation)
        except InputError as error:
            raise InputError(f"pose {self._poses - 1} at {self._time:.2f} s: {error}") from error
        if pairs:
            self.local.update(list(pairs.values()))
        taken: list[int] = []
        pose, covariance = self.local.pose.matrix(), self.local.covariance([POSE])
        for row, observation in enumerate(observations):
            if row in pairs:
                number = pairs[row].landmark
            else:
                self._numbers = number = self._numbers + 1
                self._kinds[number], self._together[number], self._smoothings[number] = observation.kind, set(), set()
                self.local.augment(number, observation)
            self._near.see(number, places[row], pose, covariance)
            taken.append(number)
        self._here.update(taken)
        for number in self._here:
            self._together[number] |= self._here
        self._seen.setdefault(self._poses - 1, []).extend(zip(taken, observations, strict=True))
        self._normaliser += sum(_log_det(observation.covariance) for observation in observations)
        self._since += len(observations)
        if self._since >= self.settings.smooth_every:
            self.smooth()
        return taken

    def smooth(self) -> None:
        """Smooth all poses and landmarks, and merge duplicates near the pose and on the ways that led to them."""
        self._since = 0
        self._add_waiting()
        self._centre, far = self._place(), np.zeros(2)
        self._read(self._centre)
        place, found = self._centre, False
        while True:
            merged = duplicates(self.local, _MERGE_GATE, self._seen_together())
            if merged:
                self._merge(merged)
                places = np.array([self._near.centre(number) for number in merged.values()])
                far, found = places[np.linalg.norm(places - place, axis=1).argmax()], True
            elif found:  # those before them on the way may be known now
                place, found = far, False
            else:
                break
            self._read(place)
        if place is not self._centre:
            self._centre = self._place()
            self._read(self._centre)

    def log_evidence(self) -> float:
        """log p(z) of all measurements so far, smoothed."""
        self.smooth()
        solution = self._smoother.snapshot().solve(_SOLVER)
        half_log_det = float(solution.linear.eliminateMultifrontal().logDeterminant())
        free = sum(solution.values.dims().values())
        expected = sum(float(np.log(kind.density)) for kind in self._kinds.values())
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
        confirm = self.settings.confirm_after
        return LandmarkMap(
            poses,
            LandmarkObservations(seen, {}).landmarks(solver.solve(), confirm),
            observations,
        )

    def _check(self, observation: Observation) -> None:
        """Raise `InputError` for what is no observation, and for one of a type for poses of another dimension."""
        require_type("observations", observation, Observation)
        kind, spatial = observation.kind, not self.local.planar
        if (kind.pose.dim == 6) != spatial:
            expected, got = ("the plane", "space") if spatial else ("space", "the plane")
            raise InputError(f"{kind.name}: expected poses in {expected} for this type, the mapper's are in {got}")

    def _place(self) -> FloatArray:
        """Place (2,) of the present pose."""
        return np.asarray(self.local.pose.matrix()[:2, -1])

    def _come_near(self) -> None:
        """Take in the landmarks that can be seen from where the vehicle has come to."""
        place = self._place()
        if np.linalg.norm(place - self._centre) > self._near.travel:
            near = self._near.near(place, self.local.covariance([POSE])).tolist()
            if self.local.kinds.keys() >= set(near):
                self._centre = place
            else:
                self.smooth()

    def _add_waiting(self) -> None:
        """Put what was measured since the last smoothing into the graph."""
        if not self._waiting and not self._seen:
            return
        last = self._poses - 1
        chunk = {row: list(now) for row, now in self._smoothed.get(last, {}).items()}
        for row, now in [*self._seen.items(), (last, [])]:
            chunk.setdefault(row, []).extend(now)
        numbers = {n for now in self._seen.values() for n, _ in now}
        observations = LandmarkObservations(chunk, {n: self.local.state(n) for n in numbers})
        near = self._near.near(self._place(), self.local.covariance([POSE])).tolist()
        self._smoother.at_root = frozenset(map(landmark_key, near))
        if self._waiting:
            self._smoother.steps([(time, [one, observations]) for time, one in self._waiting])
        else:
            self._smoother.extend([observations])
        self._smoothed[last] = chunk
        for number in numbers:
            self._smoothings[number].add(last)
        self._waiting, self._seen = [], {}

    def _merge(self, merged: Mapping[int, int]) -> None:
        """Give the observations of landmarks to others, number by number."""
        changed = {
            last: {row: [(merged.get(n, n), z) for n, z in now] for row, now in self._smoothed[last].items()}
            for last in sorted(set().union(*(self._smoothings[n] for n in merged)))
        }
        self._smoothed |= changed
        self._smoother.extend([_Merged(changed, {n: self._kinds[n].variable for n in merged})])
        self._smoother.marginalise(map(landmark_key, merged))
        for number, kept in merged.items():
            self._near.merge(number, kept)
            del self._kinds[number]
            self._smoothings[kept] |= self._smoothings.pop(number)
            others = self._together.pop(number) - {number}
            for other in others:
                self._together[other] = self._together[other] - {number} | {kept}
            self._together[kept] |= others
        self._here = {merged.get(n, n) for n in self._here}

    def _read(self, place: FloatArray) -> None:
        """Replace the Gaussian by the joint marginal, in the graph, of the pose and the landmarks near a place."""
        numbers = self._near.near(place, self.local.covariance([POSE])).tolist()
        keys = [pose_key(self._poses - 1), *map(landmark_key, numbers)]
        landmarks = {n: (self._kinds[n], self._smoother.state(landmark_key(n))) for n in numbers}
        P = self._smoother.joint_covariance(keys, rough=True)
        self.local = LocalMap(_pose(self._smoother, self._poses - 1), P, landmarks)

    def _seen_together(self) -> set[tuple[int, int]]:
        """Pairs of landmarks near the pose that were seen from one pose."""
        return {(i, j) for i in self.local.kinds for j in self._together[i] if i < j}


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
            held.append(residual_factor((key,), (variable,), off, np.eye(variable.dim), name="held"))
        return Additions(factors=held, named={last: observation_factors(chunk) for last, chunk in self.changed.items()})


def _rigid(name: str, matrix: FloatArray, size: int | None = None) -> FloatArray:
    """The transform as an array; raises `InputError` for what is none, or is not of that size."""
    try:
        pose(name, matrix)
    except FactorError as error:
        raise InputError(str(error)) from error
    T = np.asarray(matrix, dtype=np.float64)
    if size not in (None, len(T)):
        raise InputError(f"{name}: expected a {size} x {size} transform like the mapper's poses, got shape {T.shape}")
    return T


def _pose(solver: IncrementalSmoother | BatchSolver, row: int) -> FloatArray:
    pose: Any = solver.state(pose_key(row))
    return np.asarray(pose.matrix())


def _log_det(covariance: FloatArray) -> float:
    return float(np.linalg.slogdet(2 * np.pi * np.asarray(covariance))[1])

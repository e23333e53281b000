"""SLAM with landmarks whose identities nobody tells: online, in a running graph that iSAM2 keeps smoothed.

Every pose, landmark and observation is in the graph (`saga_fg.graph`), and every estimate is that of all of it. Which
observation is of which landmark is told by the joint marginal of the newest pose and those landmarks that come into
question: as a covariance P of two parts is never larger than twice its diagonal blocks,

    d^2 = r^T (A P A^T + 1)^-1 r   >=   r^T (2 A_p P_pp A_p^T + 2 A_l P_ll A_l^T + 1)^-1 r

a landmark whose right side is outside the gate is outside it for sure. What is known of a landmark only grows, so P_ll
may be an old one. Every `smooth_every` observations landmarks that turn out to be one are merged (see `merging`), with
the same bound on the pairs.

How far odometry and sensor are to be believed is itself a hypothesis, and the probability of all that was measured says
which is the better one, without any truth (Laplace's approximation at the solution x* with information matrix H):

    log p(z) = -E(x*) - 1/2 log det H + D/2 log 2 pi - 1/2 sum_i log det 2 pi R_i + sum_landmarks log density
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from factors import ResidualFactor, Solution, Variable
from saga_fg.arrays import FloatArray
from saga_fg.association import gate
from saga_fg.estimators.graph_engine import RelinearisationSettings
from saga_fg.estimators.graph_solution import GraphSolution
from saga_fg.estimators.incremental_graph import IncrementalSmoother
from saga_fg.graph import Additions, GraphView
from saga_fg.landmarks.association import associate
from saga_fg.landmarks.joint_estimate import JointEstimate
from saga_fg.landmarks.merging import duplicates, possible_duplicates
from saga_fg.landmarks.protocol import LandmarkType, Observation
from saga_fg.landmarks.providers import MeasuredMotion, Sightings, landmark_key, pose_key, sighting_factors
from saga_fg.settings import require_between, setting

_THRESHOLD = 0.05  # standard deviations that a variable moves before its factors are linearised anew


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


def landmarks_of(
    seen: Iterable[tuple[int, Observation]], solution: Solution | GraphSolution, confirm: int = 1
) -> list[Landmark]:
    """The landmarks, by number, of which these observations are, where a solution has them."""
    kinds, counts = dict[int, LandmarkType](), Counter[int]()
    for number, observation in seen:
        kinds[number] = observation.kind
        counts[number] += 1
    return [
        Landmark(
            number,
            kinds[number],
            kinds[number].variable.read(solution.values, landmark_key(number)),
            solution.marginal(landmark_key(number)),
            count,
            count >= confirm,
        )
        for number, count in sorted(counts.items())
    ]


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
        self._smoother = IncrementalSmoother(lag=None, settings=RelinearisationSettings(_THRESHOLD))
        self._sightings: list[Sighting] = []
        self._kinds: dict[int, LandmarkType] = {}
        self._bounds: dict[int, FloatArray] = {}  # covariances (d, d) of landmarks as known once
        self._numbers = self._since = 0
        self._normaliser = 0.0
        self.move(world_T_pose, covariance)

    @property
    def pose(self) -> FloatArray:
        """The newest pose (d + 1, d + 1)."""
        return np.asarray(self._pose(self._smoother.graph().epoch).matrix())

    def move(self, a_T_b: FloatArray, covariance: FloatArray) -> None:
        """Go on to the next pose by odometry: a_T_b (d + 1, d + 1), covariance of its tangent."""
        self._smoother.step(float(self._smoother.graph().epoch + 1), [MeasuredMotion(a_T_b, covariance)])
        self._normaliser += _log_det(covariance)

    def observe(self, observations: Sequence[Observation]) -> list[int]:
        """Take in what is seen from the present pose.

        Returns the number of the landmark of each; what is not surely a known one begins a new one.
        """
        if not observations:
            return []
        pairs = associate(self.estimate(self._in_question(observations)), observations, self.settings.gate)
        taken: list[int] = []
        start: dict[int, Any] = {}
        for row, observation in enumerate(observations):
            if row not in pairs:
                self._numbers += 1
                self._kinds[self._numbers] = observation.kind
                start[self._numbers] = observation.kind.initialise(self.pose, observation.value)
            taken.append(pairs[row].landmark if row in pairs else self._numbers)
        epoch = self._smoother.graph().epoch
        self._smoother.extend([Sightings({epoch: list(zip(taken, observations, strict=True))}, start)])
        for number in taken:
            self._bounds[number] = self._smoother.covariance(landmark_key(number))
        self._sightings += [Sighting(epoch, z, number) for z, number in zip(observations, taken, strict=True)]
        self._normaliser += sum(_log_det(observation.covariance) for observation in observations)
        self._since += len(observations)
        if self._since >= self.settings.smooth_every:
            self.merge()
        return taken

    def estimate(self, numbers: Iterable[int] | None = None) -> JointEstimate:
        """The newest pose and landmarks, by default all, with their joint covariance."""
        chosen = sorted(self._kinds if numbers is None else numbers)
        newest = pose_key(self._smoother.graph().epoch)
        return self._gaussian(self._smoother.joint_covariance([newest, *map(landmark_key, chosen)]), chosen)

    def merge(self) -> None:
        """Merge landmarks that turn out to be one."""
        self._since = 0
        while merged := self._duplicates():
            seen: dict[int, list[tuple[int, Observation]]] = {}
            changed = {s.pose for s in self._sightings if s.landmark in merged}
            self._sightings = [replace(s, landmark=merged.get(s.landmark, s.landmark)) for s in self._sightings]
            for s in self._sightings:
                if s.pose in changed:
                    seen.setdefault(s.pose, []).append((s.landmark, s.observation))
            self._smoother.extend([_Merged(seen, [(n, self._kinds[n].variable) for n in merged])])
            self._smoother.marginalise(map(landmark_key, merged))
            for number in merged:
                del self._kinds[number], self._bounds[number]

    def log_evidence(self) -> float:
        """log p(z) of everything measured so far."""
        self.merge()
        solution = self._smoother.snapshot().solve()
        half_log_det = float(solution.linear.eliminateMultifrontal().logDeterminant())
        free = sum(solution.values.dims().values())
        expected = sum(float(np.log(kind.density)) for kind in self._kinds.values())
        volume = 0.5 * free * float(np.log(2 * np.pi))
        return -solution.error - half_log_det + volume - 0.5 * self._normaliser + expected

    def map(self) -> LandmarkMap:
        """Everything."""
        self.merge()
        seen = ((s.landmark, s.observation) for s in self._sightings)
        landmarks = landmarks_of(seen, self._smoother.solution(), self.settings.confirm)
        poses = np.stack([self._pose(epoch).matrix() for epoch in range(self._smoother.graph().epoch + 1)])
        return LandmarkMap(poses, landmarks, list(self._sightings))

    def _pose(self, epoch: int) -> Any:
        return self._smoother.state(pose_key(epoch))

    def _gaussian(self, covariance: FloatArray, numbers: Iterable[int]) -> JointEstimate:
        landmarks = {n: (self._kinds[n], self._smoother.state(landmark_key(n))) for n in numbers}
        return JointEstimate(self.pose, covariance, landmarks)

    def _bound(self) -> JointEstimate:
        """The newest pose and all landmarks with a covariance that is larger than theirs, in blocks."""
        P = self._smoother.covariance(pose_key(self._smoother.graph().epoch))
        numbers = sorted(self._kinds)
        return self._gaussian(2 * block_diag(P, *(self._bounds[n] for n in numbers)), numbers)

    def _in_question(self, observations: Sequence[Observation]) -> set[int]:
        """The landmarks that any of the observations may be of."""
        bound, found = self._bound(), set[int]()
        for observation in observations:
            kind = observation.kind
            innovations = bound.innovations(observation, (n for n, other in self._kinds.items() if other == kind))
            if innovations:
                inside = bound.squared_distances(innovations)[0] < gate(self.settings.gate, kind.variable.dim)
                found |= {innovations[k].landmark for k in np.flatnonzero(inside).tolist()}
        return found

    def _duplicates(self) -> dict[int, int]:
        """Which landmark is to become which."""
        seen: dict[int, set[int]] = {}
        for sighting in self._sightings:
            seen.setdefault(sighting.pose, set()).add(sighting.landmark)
        apart = {(i, j) for together in seen.values() for i in together for j in together if i < j}
        pairs = possible_duplicates(self._bound(), self.settings.merge, apart)
        return (
            duplicates(self.estimate({n for pair in pairs for n in pair}), self.settings.merge, apart) if pairs else {}
        )


@dataclass(frozen=True, eq=False)
class _Merged:
    """What was seen, of landmarks under other numbers; the old ones are held where they are until they leave."""

    seen: Mapping[int, Sequence[tuple[int, Observation]]]
    old: Sequence[tuple[int, Variable]]
    name: str = Sightings.name

    def factors(self, view: GraphView) -> Additions:
        held = []
        for number, variable in self.old:
            key = landmark_key(number)
            off = partial(variable.local, view.state(key))
            held.append(ResidualFactor((key,), (variable,), off, np.eye(variable.dim), name="held"))
        return Additions(factors=held, named={k: sighting_factors({k: now}) for k, now in self.seen.items()})


def _log_det(covariance: FloatArray) -> float:
    return float(np.linalg.slogdet(2 * np.pi * np.asarray(covariance))[1])

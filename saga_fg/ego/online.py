"""Path, landmarks and objects as they come: the factor graph of the last seconds, and a joint prior for all before.

Each frame adds a moment to the window. Which objects stand is judged over the window, which observation is of which
landmark by the joint Gaussian of the new pose and the landmarks (`saga_fg.landmarks.associate`), then everything in
the window is solved anew. Moments older than `lag` leave: their poses, errors and objects, and landmarks last seen from
them, are marginalised with all factors that speak of them, linearised where they are,

    phi(x_b) = max over x_a of prod phi(x_a, x_b),      a: what leaves, b: its neighbours that stay

so that nothing they knew of the rest is lost. What was linear and Gaussian stays exact; what was not keeps the
linearisation of the moment at which it left. With a lag longer than the recording it is the batch estimate, up to the
landmarks that are told apart online.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from factors import ERROR_DIM, SolverSettings, marginal_factors, marginal_moments, nonlinear_graph_at, solve
from factors.solver import Solution
from saga_fg.arrays import FloatArray, checked_covariances
from saga_fg.ego.batch import TOLERANCE
from saga_fg.ego.estimate import JointEstimate, read_estimate
from saga_fg.ego.graph import (
    Keyed,
    error_key,
    linear_graph,
    nonlinear_factors,
    object_key,
    pose_key,
    start_graph,
)
from saga_fg.ego.landmarks import landmark_key
from saga_fg.ego.record import EgoMoment, Registration
from saga_fg.ego.settings import JointSettings
from saga_fg.ego.standing import SlowErrors, standing_probabilities
from saga_fg.errors import InputError
from saga_fg.frame import Frame
from saga_fg.geometry import checked_transform, transform_points, yaw_transform
from saga_fg.interactions import POSITION, VELOCITY
from saga_fg.landmarks import (
    JointEstimate as LandmarkEstimate,
)
from saga_fg.landmarks import (
    Landmark,
    LandmarkType,
    MapperSettings,
    Observation,
    associate,
    sighting_factors,
)
from saga_fg.tracking import Tracker


@dataclass(frozen=True, eq=False)
class OnlineStep:
    """newest: the estimate of the moment that came; settled: of those that left the window with it, oldest first."""

    newest: JointEstimate
    settled: JointEstimate | None


class OnlineEstimator:
    """Takes one frame after the other.

        estimator = OnlineEstimator(Tracker(...), lag=3.0)
        step = estimator.step(frame, a_T_b)
        step.newest.world_T_ego[-1], step.newest.objects[-1]

    tracker    a fresh one, which registers detections
    lag        s; the window begins at the last moment that is at least so old
    settings   of the graph; mapper: `gate` of telling landmarks apart, `confirm` of the observations for a sure one
    start      first pose (4, 4), by default the identity

    Raises `InputError` for a lag that is none, and a first pose that is none.
    """

    def __init__(
        self,
        tracker: Tracker,
        lag: float,
        settings: JointSettings | None = None,
        mapper: MapperSettings | None = None,
        start: FloatArray | None = None,
    ) -> None:
        if not (math.isfinite(lag) and lag >= 0):
            raise InputError(f"lag: expected a finite number of seconds >= 0, got {lag!r}")
        self._lag, self._settings, self._mapper = lag, settings or JointSettings(), mapper or MapperSettings()
        self._registration = Registration(tracker, self._settings.motion_noise)
        self._start = np.eye(4) if start is None else checked_transform("start", start)
        self._prior = gtsam.NonlinearFactorGraph()
        self._values = gtsam.Values()
        self._record: Keyed = []
        self._known: set[int] = set()
        self._sightings: list[tuple[int, int, Observation]] = []
        self._kinds: dict[int, LandmarkType] = {}
        self._count: dict[int, int] = {}
        self._gone: dict[int, Landmark] = {}
        self._slow = SlowErrors.at_start(self._settings)
        self._solution: Solution | None = None

    def step(
        self,
        frame: Frame,
        a_T_b: FloatArray | None = None,
        covariance: FloatArray | None = None,
        observations: Sequence[Observation] = (),
    ) -> OnlineStep:
        """Take in the next frame, after the vehicle moved by a_T_b (4, 4) since the last one by its odometry.

        covariance: (6, 6) of that as in `Odometry`, if the device states one; observations: of landmarks, from the new
        pose; of the first frame a_T_b is not asked for. Raises `InputError` for a motion that is missing or none, its
        covariance likewise, for a frame that is not later than the last one, or in world coordinates without a pose.
        """
        if not self._record:
            k, increment, covariance = 0, np.eye(4), None
        elif a_T_b is None:
            raise InputError("a_T_b: expected the motion since the last frame")
        else:
            k, increment = self._record[-1][0] + 1, checked_transform("a_T_b", a_T_b)
            covariance = None if covariance is None else checked_covariances("covariance", [covariance], 1, 6)[0]
        pose = self._predicted(frame.timestamp, increment)
        moment = self._registration.add(frame, pose, increment, covariance)
        self._add(k, moment, pose)
        if not self._record[:-1]:
            self._prior = start_graph(k, pose, self._settings)
        solution = self._solved()
        if observations:
            self._observe(k, solution, observations)
            solution = self._solved()
        settled = self._slide(solution)
        newest = read_estimate(self._record[-1:], solution)
        self._slow = newest.slow_errors
        return OnlineStep(newest, settled)

    def window(self) -> JointEstimate:
        """The estimate of all moments in the window. Raises `InputError` before the first frame."""
        if self._solution is None:
            raise InputError("expected a frame before the estimate is asked for")
        return read_estimate(self._record, self._solution)

    def landmarks(self) -> list[Landmark]:
        """All landmarks so far: those in the window as they are, others as they were when they left it."""
        current = [] if self._solution is None else [self._landmark(n, self._solution) for n in sorted(self._kinds)]
        return sorted([*self._gone.values(), *current], key=lambda mark: mark.number)

    def _predicted(self, time: float, a_T_b: FloatArray) -> FloatArray:
        """The pose (4, 4) by odometry, the errors that it is known to have taken out."""
        if not self._record:
            return self._start
        k, last = self._record[-1]
        scale, bias, course = self._values.atVector(error_key(k))
        step = yaw_transform(yaw=-bias * (time - last.time)) @ a_T_b
        step[:3, 3] = yaw_transform(yaw=-course)[:3, :3] @ a_T_b[:3, 3] / (1 + scale)
        return np.asarray(self._values.atPose3(pose_key(k)).matrix() @ step)

    def _add(self, k: int, moment: EgoMoment, pose: FloatArray) -> None:
        """A moment with its variables: objects where they were going, new ones where they were detected."""
        values = self._values = gtsam.Values(self._values)
        values.insert(pose_key(k), gtsam.Pose3(pose))
        j, time = (self._record[-1][0], self._record[-1][1].time) if self._record else (k, moment.time)
        values.insert(error_key(k), values.atVector(error_key(j)) if self._record else np.zeros(ERROR_DIM))
        seen = dict(zip(moment.seen.id.tolist(), transform_points(pose, moment.seen.z)[:, :2], strict=True))
        for name, node_type in zip(moment.objects.id.tolist(), moment.objects.types, strict=True):
            if values.exists(object_key(j, name)):
                state = values.atVector(object_key(j, name))
                state[node_type.index(POSITION)] += (moment.time - time) * state[node_type.index(VELOCITY)]
            else:
                state = np.zeros(node_type.dim)
                state[node_type.index(POSITION)] = seen[name]
            values.insert(object_key(k, name), state)
        self._record.append((k, moment))

    def _solved(self) -> Solution:
        moments = [moment for _, moment in self._record]
        path = np.stack([self._values.atPose3(pose_key(k)).matrix() for k, _ in self._record])
        standing = standing_probabilities(moments, path, self._slow, self._settings)
        graph = self._prior.clone()
        graph.push_back(linear_graph(self._record, self._known))
        seen, factors = sighting_factors((pose_key(k), landmark_key(n), z) for k, n, z in self._sightings)
        graph.push_back(seen)
        factors += nonlinear_factors(self._record, self._settings, standing)
        solver = SolverSettings(max_iterations=self._settings.max_iterations, tolerance=TOLERANCE)
        self._solution = solve(graph, factors, self._values, solver)
        self._values = self._solution.values
        return self._solution

    def _observe(self, k: int, solution: Solution, observations: Sequence[Observation]) -> None:
        """Tell which landmark of the window each observation is of; what is of none begins one."""
        numbers = sorted(self._kinds)
        _, P = marginal_moments(solution.linear, [pose_key(k), *map(landmark_key, numbers)], "qr")
        states = {n: (self._kinds[n], self._state(n)) for n in numbers}
        pose = self._values.atPose3(pose_key(k)).matrix()
        pairs = associate(LandmarkEstimate.of(pose, states, P), observations, self._mapper.gate)
        for row, observation in enumerate(observations):
            if row in pairs:
                number = pairs[row].landmark
            else:
                number = len(self._count) + 1
                self._kinds[number] = observation.kind
                self._values.insert(landmark_key(number), observation.kind.initialise(pose, observation.value))
            self._count[number] = self._count.get(number, 0) + 1
            self._sightings.append((k, number, observation))

    def _slide(self, solution: Solution) -> JointEstimate | None:
        """Let moments leave that are older than the lag; returns their estimate."""
        newest = self._record[-1][1].time
        count = sum(moment.time <= newest - self._lag for _, moment in self._record[1:])
        if not count:
            return None
        leaving, self._record = self._record[:count], self._record[count:]
        before, after = leaving[-1][1].objects.id, self._record[0][1].objects.id
        self._known = set(np.intersect1d(before, after).tolist())
        first = self._record[0][0]
        self._sightings = [sighting for sighting in self._sightings if sighting[0] >= first]
        still_seen = {number for _, number, _ in self._sightings}
        keys = {key for k, moment in leaving for key in _keys(k, moment)}
        for number in [n for n in self._kinds if n not in still_seen]:
            self._gone[number] = self._landmark(number, solution)
            del self._kinds[number]
            keys.add(landmark_key(number))
        self._prior = _marginalised(solution, keys, self._prior)
        settled = read_estimate(leaving, solution)
        self._values = gtsam.Values(self._values)
        for key in keys:
            self._values.erase(key)
        return settled

    def _landmark(self, number: int, solution: Solution) -> Landmark:
        covariance = marginal_moments(solution.linear, [landmark_key(number)], "qr")[1]
        count = self._count[number]
        return Landmark(
            number, self._kinds[number], self._state(number), covariance, count, count >= self._mapper.confirm
        )

    def _state(self, number: int) -> object:
        return self._kinds[number].variable.read(self._values, landmark_key(number))


def _keys(k: int, moment: EgoMoment) -> list[int]:
    """The variables of a moment."""
    return [pose_key(k), error_key(k), *(object_key(k, name) for name in moment.objects.id.tolist())]


def _marginalised(
    solution: Solution, leaving: set[int], prior: gtsam.NonlinearFactorGraph
) -> gtsam.NonlinearFactorGraph:
    """What a window says of the variables that stay without those that leave: the prior of the rest."""
    linear = solution.linear
    touched = gtsam.GaussianFactorGraph()
    for i in range(linear.size()):
        if not leaving.isdisjoint(linear.at(i).keys()):
            touched.push_back(linear.at(i))
    remaining = marginal_factors(touched, sorted(leaving), "qr")
    kept = gtsam.NonlinearFactorGraph()
    for i in range(prior.size()):
        if leaving.isdisjoint(prior.at(i).keys()):
            kept.add(prior.at(i))
    kept.push_back(nonlinear_graph_at((remaining.at(i) for i in range(remaining.size())), solution.values))
    return kept

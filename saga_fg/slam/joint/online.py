"""Path, landmarks and objects as they come: the running graph of the last seconds, and a joint prior for all before.

Each frame adds a moment to the window. Which objects stand is judged over the window, which observation is of which
landmark by the joint Gaussian of the new pose and the landmarks (`saga_fg.slam.mapping.associate`), which vehicle keeps
which lane by the pose as known then (`saga_fg.slam.joint.lanes`), and iSAM2 solves the window with what is new. Moments
older than `lag` leave, and landmarks last seen from them (`saga_fg.slam.joint.window`). With a lag longer than the
recording it is the batch estimate, up to what is told apart online.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from saga_fg.errors import InputError
from saga_fg.estimators.graph_solution import GraphSolution
from saga_fg.graph import FactorProvider
from saga_fg.numerics.arrays import FloatArray, checked_covariances
from saga_fg.numerics.geometry import checked_transform
from saga_fg.slam.joint.estimate import JointEstimate, read_estimate
from saga_fg.slam.joint.lane_keeping import LaneKeeping
from saga_fg.slam.joint.record import EgoMoment, Registration
from saga_fg.slam.joint.settings import JointSettings
from saga_fg.slam.joint.standing import SlowErrors, standing_probabilities
from saga_fg.slam.joint.window import Window
from saga_fg.slam.joint.window_landmarks import WindowLandmarks
from saga_fg.slam.mapping import MapperSettings
from saga_fg.tracking import Tracker
from saga_fg.types.frame import Frame
from saga_fg.types.landmark import Landmark, Observation


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
    providers  of factors of your own, asked when vehicle and objects of a frame are in

    Raises `InputError` for a lag that is none, and a first pose that is none.
    """

    def __init__(
        self,
        tracker: Tracker,
        lag: float,
        settings: JointSettings | None = None,
        mapper: MapperSettings | None = None,
        start: FloatArray | None = None,
        providers: Sequence[FactorProvider] = (),
    ) -> None:
        if not (math.isfinite(lag) and lag >= 0):
            raise InputError(f"lag: expected a finite number of seconds >= 0, got {lag!r}")
        self._lag, self._settings = lag, settings or JointSettings()
        self._registration = Registration(tracker, self._settings.online_motion_noise)
        self._start = np.eye(4) if start is None else checked_transform("start", start)
        self._window = Window(self._settings, providers)
        self._landmarks = WindowLandmarks(mapper or MapperSettings())
        self._lanes = LaneKeeping(self._settings.lanes, [tracker.settings.road_map])
        self._standing: list[FloatArray] = []
        self._slow = SlowErrors.at_start(self._settings)
        self._solution: GraphSolution | None = None

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
        window = self._window
        if not window.record:
            pose, increment, covariance = self._start, np.eye(4), None
        elif a_T_b is None:
            raise InputError("a_T_b: expected the motion since the last frame")
        else:
            increment = checked_transform("a_T_b", a_T_b)
            covariance = None if covariance is None else checked_covariances("covariance", [covariance], 1, 6)[0]
            pose = window.predicted(frame.timestamp, increment)
        moment = self._registration.add(frame, pose, increment, covariance)
        self._lanes.learn(frame.road_map)
        before = [] if not window.record else list(window.path)
        self._standing = self._judged([*(one for _, one in window.record), moment], np.stack([*before, pose]))
        solution = window.add(moment, pose, self._standing)
        more: list[FactorProvider] = []
        if observations:
            more.append(self._landmarks.observe(window.record[-1][0], solution, observations))
        if self._lanes.assign(window.record, read_estimate(window.record[-1:], solution), self._standing[-1:]):
            more.append(self._lanes)
        if more:
            self._standing = self._judged([one for _, one in window.record], window.path)
            solution = window.extend(self._standing, more)
        self._solution = solution
        settled = self._slide(solution)
        newest = read_estimate(window.record[-1:], solution)
        self._slow = newest.slow_errors
        return OnlineStep(newest, settled)

    def window(self) -> JointEstimate:
        """The estimate of all moments in the window. Raises `InputError` before the first frame."""
        if self._solution is None:
            raise InputError("expected a frame before the estimate is asked for")
        return read_estimate(self._window.record, self._solution)

    def landmarks(self) -> list[Landmark]:
        """All landmarks so far: those in the window as they are, others as they were when they left it."""
        return self._landmarks.all(self._solution)

    def _judged(self, moments: list[EgoMoment], path: FloatArray) -> list[FloatArray]:
        """For each moment the probabilities that its objects stand, along a path (n, 4, 4)."""
        return standing_probabilities(moments, path, self._slow, self._settings, online=True)

    def _slide(self, solution: GraphSolution) -> JointEstimate | None:
        """Let moments leave that are older than the lag; returns their estimate."""
        window = self._window
        count = window.older_than(window.record[-1][1].time - self._lag)
        if not count:
            return None
        settled = read_estimate(window.record[:count], solution)
        first = window.record[count][0]
        window.leave(count, [*self._landmarks.leave(first, solution), *self._lanes.leave(first)])
        return settled

"""Incremental SLAM in submaps: one running graph of bounded size, and the record to solve it whole.

    keyframes and landmarks of the running submap      as they come, in iSAM2
    closed submaps                                     one factor each, between its anchor and the next
    loops                                              factors between anchors, under a robust loss

A submap is anchored at its first keyframe. When it is long enough, the keyframe at hand becomes the anchor of the next
one, and everything in between is eliminated (`CondensedSubmap`). Landmarks belong to one submap: what is seen on is a
landmark of the next again, and they are tied through the poses.

So the running graph has the submap at hand and the anchors of all others, and a keyframe costs nearly as much at the
end of a drive as at its beginning.

The measurements themselves are kept. `finish` chooses the loops that agree (`select_loops`), and solves everything
together, nothing condensed, from the running estimate.

Observations are associated with the landmarks of the running submap. Pose and landmarks of the submap are one Gaussian
in the frame of its anchor (`LocalMap`), so that a submap far from the start is associated as the first one. Walls and
lines are finite: two pieces farther apart along the wall than `_GAP` are not of one, though in one plane, as the fronts
of houses in a row are.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any

import numpy as np

from factors import Robust, SolverSettings
from saga_fg.errors import InputError
from saga_fg.estimators import BatchSolver, GraphSolution, IncrementalSmoother, RelinearisationSettings
from saga_fg.graph import Additions, FactorProvider, GraphView, SceneFactorGraph, ask_all
from saga_fg.numerics import FloatArray, inverse_transform, transform_points
from saga_fg.settings import Positive, Range, Settings, setting
from saga_fg.slam.mapping import (
    Given,
    LandmarkObservations,
    LocalMap,
    MeasuredMotion,
    associate,
    landmark_key,
    pose_key,
)
from saga_fg.slam.submaps.between import (
    CondensedSubmap,
    LoopClosure,
    Loops,
    LoopSelection,
    Motion,
    loop_factors,
    select_loops,
)
from saga_fg.types import Frame, Landmark, Observation

_GAP = 3.0  # m
_ANCHOR = 1e-12 * np.eye(6)  # covariance of the anchor in its own frame


@dataclass(frozen=True, eq=False)
class SubmapLandmarks:
    """The landmarks of one submap, seen from its anchor on.

    local  pose and landmarks; ends: by number (2, 2) of walls and lines, from above
    """

    local: LocalMap = field(default_factory=lambda: LocalMap(np.eye(4), _ANCHOR))
    ends: dict[int, FloatArray] = field(default_factory=dict)

    def copy(self) -> SubmapLandmarks:
        """A copy that further observations can be associated with."""
        return SubmapLandmarks(self.local.copy(), dict(self.ends))

    def observe(self, observations: Sequence[Observation], first: int) -> list[int]:
        """Return the number of the landmark of each observation; new ones are numbered from `first` > 0 on."""
        T = self.local.pose.matrix()
        ends = [None if one.extent is None else transform_points(T, one.extent)[:, :2] for one in observations]

        def near(row: int, landmark: int) -> bool:
            return _gap(self.ends.get(landmark), ends[row]) <= _GAP

        pairs = associate(self.local, observations, near)
        if pairs:
            self.local.update(list(pairs.values()))
        taken = list[int]()
        for row, observation in enumerate(observations):
            number = pairs[row].landmark if row in pairs else first
            if number == first:
                self.local.augment(first, observation)
                first += 1
            if (seen := ends[row]) is not None:
                self.ends[number] = _together(self.ends.get(number), seen)
            taken.append(number)
        return taken


def _gap(known: FloatArray | None, seen: FloatArray | None) -> float:
    """Gap between two pieces along the first one, m."""
    if known is None or seen is None:
        return 0.0
    along = _direction(known)
    (low, high), (first, second) = np.sort(known @ along), np.sort(seen @ along)
    return float(max(first - high, low - second, 0.0))


def _together(known: FloatArray | None, seen: FloatArray) -> FloatArray:
    """The ends of both pieces together, along the first one."""
    if known is None:
        return seen
    every = np.concatenate([known, seen])
    u = every @ _direction(known)
    return every[[int(u.argmin()), int(u.argmax())]]


def _direction(ends: FloatArray) -> FloatArray:
    off = ends[1] - ends[0]
    length = float(np.linalg.norm(off))
    return off / length if length > 0 else np.array([1.0, 0.0])


@dataclass(eq=False)
class Recorded:
    """A provider whose additions are kept, by epoch."""

    provider: FactorProvider
    additions: dict[int, list[Additions]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        return str(getattr(self.provider, "name", type(self.provider).__name__))

    def predict(self, view: GraphView) -> Additions:
        predict = getattr(self.provider, "predict", None)
        return self._kept(view, predict(view)) if callable(predict) else Additions()

    def factors(self, view: GraphView) -> Additions:
        return self._kept(view, self.provider.factors(view))

    def again(self, epoch: int) -> list[FactorProvider]:
        """Providers of what this one gave at an epoch."""
        return [Given(one, self.name) for one in self.additions.get(epoch, ())]

    def _kept(self, view: GraphView, added: Additions) -> Additions:
        if isinstance(added, Additions):
            self.additions.setdefault(view.epoch, []).append(added)
        return added


@dataclass(frozen=True)
class SubmapSettings(Settings):
    """Size of submaps, association and confirmation of landmarks."""

    length: Positive = setting(
        30.0, "distance travelled after which the next submap begins, m; usual 20 to 50; higher: slower"
    )
    confirm_after: Annotated[int, Range(1, 10**9)] = setting(4, "observations that confirm a landmark")
    relinearise_above: Positive = setting(
        0.5, "linearise factors again when a variable moved by this many standard deviations; higher: faster"
    )
    robust_scale: Positive = setting(
        3.0,
        "residual from which losses discount poles (Geman-McClure) and loops (Cauchy, which pulls from far), "
        "standard deviations",
    )

    @property
    def robust(self) -> Robust:
        """The loss of landmarks."""
        return Robust("geman-mcclure", self.robust_scale)


_SOLVER = SolverSettings(tolerance=1e-4, max_iterations=30)
_AFTER_LOOPS = RelinearisationSettings(0.01)  # deviations are those before the loop, which makes them smaller
MAX_KEYFRAMES = 80  # keyframes after which the next submap begins, however short the distance


@dataclass(frozen=True, eq=False)
class SolvedDrive:
    """Everything solved together: N poses (N, 4, 4), and the landmarks seen often enough.

    solution: of the whole graph, with all variables; graph: that, at its solution; loops: which of those that came are
    in it, and with what deviations of odometry
    """

    world_T_pose: FloatArray
    landmarks: list[Landmark]
    solution: GraphSolution
    graph: SceneFactorGraph
    loops: LoopSelection

    @cached_property
    def covariances(self) -> FloatArray:
        """Covariances (N, 6, 6) of the poses, (rotation, translation) in the frame of each."""
        return np.array([self.solution.marginal(pose_key(k)) for k in range(len(self.world_T_pose))])


class SubmapGraph:
    """Add keyframes in order of time; read poses at any moment; `finish` at the end.

    graph = SubmapGraph(world_T_first, covariance)
    graph.append(0.0, None, observations)
    graph.append(0.1, (last_T_new, covariance), observations)      # True: a submap was closed, and the next begun
    ...
    graph.finish().world_T_pose

    providers: of other factors, asked at every keyframe; frames that are given with keyframes are theirs to read. An
    error of theirs leaves the graph as it was before the keyframe.
    """

    def __init__(
        self,
        world_T_first: FloatArray,
        covariance: FloatArray,
        settings: SubmapSettings | None = None,
        providers: Sequence[FactorProvider] = (),
    ) -> None:
        self.settings = settings or SubmapSettings()
        self._providers = [Recorded(provider) for provider in providers]
        relinearisation = RelinearisationSettings(self.settings.relinearise_above)
        self.smoother = IncrementalSmoother(lag=None, settings=relinearisation, elimination="cholesky")
        self._motions: list[Motion] = [(world_T_first, covariance)]
        self._times: list[float] = []
        self.seen: list[Sequence[tuple[int, Observation]]] = []  # by keyframe, with the numbers of landmarks
        self.anchors: list[int] = []  # keyframes, that of the running submap last
        self._offsets: list[FloatArray] = []  # of keyframes from the anchors of their submaps, where that is closed
        self._loops: list[LoopClosure] = []  # between submaps, by their numbers
        self._landmarks = SubmapLandmarks()
        self._numbers, self._travelled = 1, 0.0  # of the next landmark; m since the anchor

    def __len__(self) -> int:
        return len(self._times)

    def append(
        self,
        time: float,
        motion: Motion | None,
        observations: Sequence[Observation] = (),
        frame: Frame | None = None,
    ) -> bool:
        """Add the next keyframe; returns whether it closed a submap and is the anchor of the next.

        motion: last_T_new (4, 4) and the covariance (6, 6) of its tangent; None for the first one
        """
        k = len(self)
        if (motion is None) != (k == 0):
            raise InputError("motion: expected one for every keyframe but the first")
        measured = self._motions[0] if motion is None else motion
        travelled = self._travelled + (0.0 if motion is None else float(np.linalg.norm(measured[0][:3, 3])))
        begins = k == 0 or travelled >= self.settings.length or k - self.anchors[-1] >= MAX_KEYFRAMES
        start = measured[0] if k == 0 else self.pose(k - 1) @ measured[0]
        landmarks = SubmapLandmarks() if begins else self._landmarks.copy()
        if motion is not None and not begins:
            landmarks.local.predict(*motion)
        numbers = landmarks.observe(observations, self._numbers)
        now = list(zip(numbers, observations, strict=True))
        motion_provider = MeasuredMotion(*measured, start)
        starts = {n: one.kind.initialise(start, one.value) for n, one in now if n >= self._numbers}
        seen = LandmarkObservations({k: now}, starts, self.settings.robust)
        self.smoother.step(time, [motion_provider, seen, *self._providers], frame)
        self._landmarks, self._travelled = landmarks, travelled
        self._numbers = max(self._numbers, *(n + 1 for n in numbers), 0)
        if k:
            self._motions.append(measured)
        self._times.append(time)
        self.seen.append(now)
        if begins:
            self._begin_submap(k)
        return begins and k > 0

    def close_loops(self, loops: Sequence[LoopClosure]) -> None:
        """Add loops between submaps, by their numbers, and solve."""
        for loop in loops:
            if not 0 <= loop.first < loop.second < len(self.anchors):
                raise InputError(f"loop: expected two submaps in order, got {loop.first} and {loop.second}")
        if not loops:
            return
        factors = loop_factors(loops, self.anchors, Robust("cauchy", self.settings.robust_scale))
        self.smoother.extend([Given(Additions(factors=factors), "loops")], settings=_AFTER_LOOPS)
        self._loops += loops

    def pose(self, k: int) -> FloatArray:
        """The present estimate (4, 4) of a keyframe's pose; in a closed submap it goes along with the anchor."""
        if k < len(self._offsets):
            number = int(np.searchsorted(self.anchors, k, side="right")) - 1
            return np.asarray(self._running(self.anchors[number]) @ self._offsets[k])
        return self._running(k)

    def covariance(self) -> FloatArray:
        """The covariance (6, 6) of the newest keyframe's pose."""
        return self.smoother.covariance(pose_key(len(self) - 1))

    def world_T_anchor(self) -> FloatArray:
        """The present estimates (n, 4, 4) of all anchors."""
        return np.array([self._running(anchor) for anchor in self.anchors])

    def poses(self) -> FloatArray:
        """The present estimates (N, 4, 4) of all keyframes."""
        closed = len(self._offsets)
        of = np.searchsorted(self.anchors, np.arange(closed), side="right") - 1
        poses = np.empty((len(self), 4, 4))
        poses[:closed] = self.world_T_anchor()[of] @ np.array(self._offsets).reshape(-1, 4, 4)
        for k in range(closed, len(self)):
            poses[k] = self._running(k)
        return poses

    def finish(self) -> SolvedDrive:
        """Choose the loops that agree, and solve all measurements together."""
        if not len(self):
            raise InputError("expected at least one keyframe before the end")
        loops = select_loops(self._motions[1:], self.anchors, self._loops)
        graph, landmarks = self.measurements(loops)
        solver = BatchSolver(graph=graph, settings=_SOLVER)
        solution, solved = solver.solve(), solver.graph()
        poses = [solution.values.atPose3(pose_key(k)).matrix() for k in range(len(self))]
        marks = landmarks.landmarks(solution, self.settings.confirm_after)
        return SolvedDrive(np.array(poses), marks, solution, solved, loops)

    def measurements(self, chosen: LoopSelection) -> tuple[SceneFactorGraph, LandmarkObservations]:
        """The graph of all measurements with the loops chosen, nothing condensed, at the present estimate; and the
        observations of landmarks in it, those confirmed."""
        graph, poses = SceneFactorGraph(), self.poses()
        landmarks = LandmarkObservations(self._confirmed(), self._starts(poses), self.settings.robust)
        loops = Loops([loop for loop, kept in zip(self._loops, chosen.kept, strict=True) if kept], self.anchors)
        for k, (time, (moved, covariance)) in enumerate(zip(self._times, self._motions, strict=True)):
            graph.advance(time)
            motion = MeasuredMotion(moved, chosen.inflated(covariance) if k else covariance, poses[k])
            others = (again for provider in self._providers for again in provider.again(k))
            ask_all([motion, landmarks, loops, *others], graph)
        return graph, landmarks

    def _running(self, k: int) -> FloatArray:
        state: Any = self.smoother.state(pose_key(k))
        return np.asarray(state.matrix())

    def _begin_submap(self, k: int) -> None:
        """Close the running submap, if any, and make the keyframe k an anchor."""
        if k:
            self._close(self.anchors[-1], k)
        self.anchors.append(k)
        self._travelled = 0.0

    def _close(self, anchor: int, successor: int) -> None:
        mine = {n for now in self.seen[anchor:successor] for n, _ in now}
        world = inverse_transform(self._running(anchor))
        self._offsets += [np.eye(4), *(world @ self._running(k) for k in range(anchor + 1, successor))]
        variables, anchors = self.smoother.graph().variables.values(), set(map(pose_key, self.anchors))
        old = [one.key for one in variables if one.epoch is not None and one.epoch < successor]
        leaving = [*(key for key in old if key not in anchors), *map(landmark_key, mine)]
        self.smoother.marginalise(leaving, CondensedSubmap(pose_key(anchor), pose_key(successor)))

    def _confirmed(self) -> dict[int, Sequence[tuple[int, Observation]]]:
        """Observations of landmarks that were seen often enough, by keyframe."""
        counts = Counter(n for now in self.seen for n, _ in now)
        often = {n for n, count in counts.items() if count >= self.settings.confirm_after}
        return {k: [(n, one) for n, one in now if n in often] for k, now in enumerate(self.seen)}

    def _starts(self, poses: FloatArray) -> Mapping[int, Any]:
        """Initial values of landmarks; in closed submaps from the last observation, since anchors have moved."""
        start: dict[int, Any] = {}
        running = self.smoother.graph().variables
        for k, now in enumerate(self.seen):
            for number, one in now:
                if landmark_key(number) not in running:
                    start[number] = one.kind.initialise(poses[k], one.value)
                elif number not in start:
                    start[number] = self.smoother.state(landmark_key(number))
        return start

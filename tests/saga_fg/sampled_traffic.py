"""Traffic sampled from the model of the running graph: a vehicle drives by odometry and sees, in range and bearing,
cars that follow each other (intelligent driver) and pedestrians who keep apart (social force).

Cars and pedestrians come and go, are missed now and then, and time is irregular. Three providers give the very factors
of the sampled model to an estimator, so that its covariances must fit the errors.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gtsam
import numpy as np

from factors import (
    RangeBearing,
    ResidualFactors,
    Robust,
    between_factor,
    pose_prior_factor,
    prior_factors,
    relative_factors,
)
from factors.validation import KeyArray
from saga_fg.graph import EGO_POSE, OBJECT, Additions, FactorProvider, GraphView, NewVariable
from saga_fg.model import SmoothDriver, SocialForce, held
from saga_fg.numerics import FloatArray

INITIAL_POSE_COVARIANCE = np.diag([0.05, 0.05, 0.01]) ** 2
ODOMETRY_COVARIANCE = np.diag([0.05, 0.03, 0.01]) ** 2
RANGE_BEARING_COVARIANCE = np.diag([0.15, 0.01]) ** 2
INITIAL_STATE_COVARIANCE = np.diag([1.0, 1.0, 0.5, 0.5]) ** 2
NOISE = 0.3  # spectral density of accelerations, m^2/s^3


@dataclass(frozen=True)
class Interaction:
    """A law of the package as factors || x' - f(x, others) ||_Q of states (p, v), with any number of neighbours."""

    law: SmoothDriver | SocialForce

    def predict(self, x: FloatArray, others: Sequence[FloatArray], dt: float) -> FloatArray:
        """Return f (..., 4) of states x (..., 4) and of the neighbours' (..., 4)."""
        moved = x + dt * np.concatenate([x[..., 2:], np.zeros_like(x[..., 2:])], axis=-1)
        for other in others:
            moved = moved + held(self.law.accelerations(x, other, self.law.alone).value[..., None], dt)[..., 0]
        return moved

    def jacobians(self, x: FloatArray, others: Sequence[FloatArray], dt: float) -> tuple[FloatArray, list[FloatArray]]:
        """Return the derivatives (..., 4, 4) of f by x, and by each neighbour's state."""
        own = np.broadcast_to(np.eye(4) + dt * np.eye(4, k=2), (*x.shape, 4))
        by_others = []
        for other in others:
            _, by_own, by_other = self.law.accelerations(x, other, self.law.alone)
            own = own + held(by_own, dt)
            by_others.append(held(by_other, dt))
        return own, by_others

    def factors(self, rows: KeyArray, dt: float, Q: FloatArray) -> ResidualFactors:
        """Return the factors of nodes: rows (n, 2 + k) of the keys after the interval, before, and of neighbours."""
        residual, jacobians = partial(self._residual, dt), partial(self._residual_jacobians, dt)
        name = f"{type(self.law).__name__} interactions"
        return ResidualFactors(rows, (4,) * rows.shape[1], residual, Q, jacobians, name=name)

    def _residual(self, dt: float, later: FloatArray, x: FloatArray, *others: FloatArray) -> FloatArray:
        return later - self.predict(x, others, dt)

    def _residual_jacobians(self, dt: float, later: FloatArray, x: FloatArray, *others: FloatArray) -> list[FloatArray]:
        own, by_others = self.jacobians(x, others, dt)
        return [np.broadcast_to(np.eye(4), own.shape), -own, *(-J for J in by_others)]


_FOLLOWING, _REPULSION = Interaction(SmoothDriver()), Interaction(SocialForce())
States = dict[int, FloatArray]


def process_noise(dt: float) -> FloatArray:
    """Q (4, 4) of a state (x, y, vx, vy) over dt s."""
    return np.asarray(NOISE * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2)))


@dataclass
class SampledFrame:
    """True states and pose of a frame, with what an estimator is given.

    dt, odometry    since the frame before, s
    new             prior means of new objects
    seen            range, m, and bearing, rad, of the detected objects
    """

    time: float
    dt: float
    pose: gtsam.Pose2
    odometry: gtsam.Pose2
    states: States
    new: States
    seen: States


@dataclass
class SampledTraffic:
    """A sampled scene.

    start       mean of the first pose of the vehicle
    kinds       "car" or "pedestrian" by id
    leaders     id of the car ahead, by id
    """

    start: gtsam.Pose2
    kinds: dict[int, str] = field(default_factory=dict)
    leaders: dict[int, int] = field(default_factory=dict)
    frames: list[SampledFrame] = field(default_factory=list)

    def neighbours(self, node: int, present: Collection[int]) -> list[int]:
        """Return the nodes that act on a node: the leader of a car, all other pedestrians on a pedestrian."""
        if self.kinds[node] == "car":
            return [self.leaders[node]] if self.leaders.get(node) in present else []
        return [other for other in sorted(present) if other != node and self.kinds[other] == "pedestrian"]

    def interaction(self, node: int, near: Sequence[int]) -> Interaction:
        """Return the interaction function of a node with these neighbours; without any it keeps its velocity."""
        if self.kinds[node] == "car" and near:
            return _FOLLOWING
        return _REPULSION


def sample_traffic(
    rng: np.random.Generator,
    frames: int = 12,
    cars: int = 4,
    pedestrians: int = 3,
    intervals: Sequence[float] = (0.05, 0.1, 0.2, 0.5),
) -> SampledTraffic:
    """A scene of so many frames, with intervals in between that are drawn from `intervals`, s."""
    waiting: dict[int, tuple[FloatArray, int]] = {}
    heading = rng.uniform(-0.3, 0.3)
    scene = SampledTraffic(gtsam.Pose2(0, 0, heading))
    along, side = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    for k in range(cars):
        place = (20 + 14 * (cars - k) + rng.normal()) * along + 3 * side
        waiting[k] = np.concatenate([place, rng.uniform(7, 9) * along]), int(rng.integers(0, 4)) if k else 0
        scene.kinds[k] = "car"
        if k:
            scene.leaders[k] = k - 1
    for k in range(cars, cars + pedestrians):
        place = 15 * along - 6 * side + rng.normal(0, 1.0, 2)
        waiting[k] = np.concatenate([place, rng.normal(0, 0.6, 2)]), int(rng.integers(0, 4))
        scene.kinds[k] = "pedestrian"
    leaving = {node: int(rng.integers(frames // 2, 2 * frames)) for node in waiting}
    time, pose = 0.0, scene.start.retract(np.linalg.cholesky(INITIAL_POSE_COVARIANCE) @ rng.normal(size=3))
    states: States = {}
    for k in range(frames):
        dt = float(rng.choice(intervals)) if k else 0.0
        time += dt
        step = gtsam.Pose2(8 * dt, 0, 0.05 * dt)
        if k:
            pose = pose.compose(step).retract(np.linalg.cholesky(ODOMETRY_COVARIANCE) @ rng.normal(size=3))
        states = {node: x for node, x in states.items() if leaving[node] > k}
        moved = {}
        for node, x in states.items():
            near = scene.neighbours(node, states)
            f = np.asarray(scene.interaction(node, near).predict(x, [states[other] for other in near], dt))
            moved[node] = f + np.linalg.cholesky(process_noise(dt)) @ rng.normal(size=4)
        initial = {node: x for node, (x, first) in waiting.items() if first == k and leaving[node] > k}
        states = moved | {
            node: x + np.linalg.cholesky(INITIAL_STATE_COVARIANCE) @ rng.normal(size=4) for node, x in initial.items()
        }
        seen = {}
        for node, x in states.items():
            if rng.random() < 0.8:
                s = pose.transformTo(x[:2])
                z = np.array([np.hypot(*s), np.arctan2(s[1], s[0])])
                seen[node] = z + np.linalg.cholesky(RANGE_BEARING_COVARIANCE) @ rng.normal(size=2)
        scene.frames.append(SampledFrame(time, dt, pose, step, states, initial, seen))
    return scene


class VehicleProvider:
    """The ego pose, by odometry."""

    name = "odometry"

    def __init__(self, scene: SampledTraffic) -> None:
        self.scene = scene

    def factors(self, view: GraphView) -> Additions:
        """A prior at first, odometry later."""
        frame, key = self.scene.frames[view.epoch], view.key(EGO_POSE, 0)
        if view.epoch == 0:
            new = NewVariable(EGO_POSE, 0, self.scene.start, label="vehicle")
            return Additions([new], [pose_prior_factor(key, self.scene.start.matrix(), INITIAL_POSE_COVARIANCE)])
        before = view.before(EGO_POSE)[0].key
        new = NewVariable(EGO_POSE, 0, view.state(before).compose(frame.odometry), label="vehicle")
        return Additions([new], [between_factor(before, key, frame.odometry.matrix(), ODOMETRY_COVARIANCE)])


class ObjectProvider:
    """New objects and interactions, those of one shape in one batch."""

    name = "interactions"

    def __init__(self, scene: SampledTraffic) -> None:
        self.scene = scene

    def factors(self, view: GraphView) -> Additions:
        """Return variables, priors and interactions of all present objects."""
        frame, before = self.scene.frames[view.epoch], view.before(OBJECT)
        new: list[NewVariable] = []
        batches: dict[tuple[Interaction, int], list[list[int]]] = {}
        for node in frame.states:
            label = self.scene.kinds[node]
            if node in frame.new:
                new.append(NewVariable(OBJECT, node, frame.new[node], label=label))
                continue
            near = self.scene.neighbours(node, before)
            motion, states = self.scene.interaction(node, near), [view.state(before[i].key) for i in (node, *near)]
            new.append(NewVariable(OBJECT, node, motion.predict(states[0], states[1:], frame.dt), label=label))
            batches.setdefault((motion, len(near)), []).append([node, *near])
        initial = list(frame.new)
        factors: list[Any] = []
        if initial:
            keys, states = [view.key(OBJECT, i) for i in initial], [frame.new[i] for i in initial]
            factors.append(prior_factors(keys, states, INITIAL_STATE_COVARIANCE))
        for (motion, _), rows in batches.items():
            names = [[view.key(OBJECT, row[0]), *(before[i].key for i in row)] for row in rows]
            factors.append(motion.factors(np.array(names, dtype=np.uint64), frame.dt, process_noise(frame.dt)))
        return Additions(new, factors)


class DetectionProvider:
    """Range and bearing from the vehicle."""

    name = "detections"

    def __init__(self, scene: SampledTraffic, robust: Robust | None = None) -> None:
        self.scene, self.robust = scene, robust

    def factors(self, view: GraphView) -> Additions:
        """Return the factors of all detected objects."""
        seen = self.scene.frames[view.epoch].seen
        if not seen:
            return Additions()
        rows = np.array([[view.key(EGO_POSE, 0), view.key(OBJECT, node)] for node in seen], dtype=np.uint64)
        z = np.stack(list(seen.values()))
        return Additions(
            factors=[relative_factors(rows, z, RANGE_BEARING_COVARIANCE, 4, robust=self.robust, model=RangeBearing(2))]
        )


def providers(scene: SampledTraffic, robust: Robust | None = None) -> list[FactorProvider]:
    """Return providers of the factors of the model that a scene was sampled from."""
    return [VehicleProvider(scene), ObjectProvider(scene), DetectionProvider(scene, robust)]

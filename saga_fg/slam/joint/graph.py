"""The vehicle's path and the objects around it, from a whole recording: factors of a record, and their solution.

Factors of a record: poses of the vehicle, errors of its odometry, and states of objects, over time.

    prior        first pose; first errors; velocity of a new object
    odometry     poses and errors of two epochs            (`factors.between`)
    interaction  an object's next state and the states of all that act on it
    detection    a pose and an object's state              (`factors.relative`), robust
    stationary   p' - p ~ N(0, stationary_drift^2 dt),  v' ~ N(0, stationary_speed^2)     with probability P

The last one is the hybrid part of the model. With the probability P (`saga_fg.slam.joint.record`) an object is
stationary and a landmark, else it moves as its class does and the factor is silent: a mixture (`factors.Mixture`). A
variable is a `gtsam.Pose3` for the vehicle and a vector for everything else.

Providers add them, for a whole recording or a window of epochs.

Discrete unknowns depend on the path: the association of detections, and the stationarity of objects. A pass associates
along the path so far, starting with the odometry's, takes the probabilities of stationarity from the detections, and
solves the graph of all epochs. Passes end when associations repeat.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np

from factors import (
    ERROR_DIM,
    GaussianFactors,
    Mixture,
    ResidualFactors,
    Robust,
    Solution,
    SolverSettings,
    gaussian_factors,
    odometry_factors,
    pose_prior_factor,
    prior_factor,
    relative_factors,
)
from saga_fg.errors import InputError
from saga_fg.estimators import Interactions
from saga_fg.graph import (
    EGO_ERROR,
    EGO_POSE,
    OBJECT,
    Additions,
    Factor,
    FactorProvider,
    GraphView,
    NewVariable,
    SceneFactorGraph,
    ask_all,
    key_of,
)
from saga_fg.model import POSITION, VELOCITY, NodeType
from saga_fg.numerics import Assignment, FloatArray, IntArray, transform_points
from saga_fg.slam.joint.record import (
    MAX_ITERATIONS,
    JointSettings,
    OdometryIncrements,
    RecordedEpoch,
    RecordedObjects,
    motion_covariances,
    record_epochs,
    stationary_probabilities,
)
from saga_fg.slam.mapping import pose_key
from saga_fg.tracking import Tracker
from saga_fg.types import Frame

START_NOISE = 1e-3  # standard deviation of the first pose, m and rad
LIKELY = 0.9  # stationary with less than this probability: no such factor, since creeping queues are in doubt, too
_ANY_SPEED = 100.0  # m/s, deviation of an unknown velocity
Record = Sequence[RecordedEpoch]
STATIONARY_DRIFT = 0.05  # standard deviation of a stationary object's drift in one second, m
STATIONARY_SPEED = 0.1  # standard deviation of the velocity of a stationary object, m/s


def error_key(epoch: int) -> int:
    """Key of the odometry's slow errors (scale, bias of the yaw rate, course) at an epoch."""
    return key_of(EGO_ERROR, 0, epoch)


def object_key(epoch: int, name: int) -> int:
    """Key of an object's state at an epoch."""
    return key_of(OBJECT, name, epoch)


def odometry(record: Record, settings: JointSettings) -> list[ResidualFactors]:
    """Poses and slow errors of consecutive epochs."""
    if len(record) < 2:
        return []
    pairs = [(before.epoch, now.epoch) for before, now in pairwise(record)]
    rows = np.array([[pose_key(j), pose_key(k), error_key(j), error_key(k)] for j, k in pairs], dtype=np.uint64)
    steps = np.stack([now.a_T_b for now in record[1:]])
    dt = np.diff([now.time for now in record])
    return [odometry_factors(rows, steps, dt, motion_covariances(record, settings))]


def _by_type(rows: Iterable[tuple[Any, ...]]) -> Iterator[tuple[NodeType, tuple[FloatArray, ...]]]:
    """Columns of rows, each a node type and numbers, for each type."""
    collected: dict[NodeType, list[Any]] = {}
    for node_type, *numbers in rows:
        collected.setdefault(node_type, []).append(numbers)
    for node_type, mine in collected.items():
        yield node_type, tuple(np.array(column) for column in zip(*mine, strict=True))


def _priors(k: int, new: RecordedObjects) -> list[GaussianFactors]:
    """All components of new objects but the position: unknown velocities, and others, N(0, 1).

    The usual motion of a class must not be a prior of each object: in traffic all go the same way, and a hundred small
    errors of one sign would pull at the vehicle.
    """
    factors = []
    for node_type, (names,) in _by_type(zip(new.types, new.id, strict=True)):
        rest = [c for c in node_type.components if c not in POSITION]
        keys = np.array([[object_key(k, name)] for name in names.tolist()], dtype=np.uint64)
        H = np.tile(node_type.selector(rest), (len(keys), 1, 1))
        variance = np.diag([_ANY_SPEED**2 if c in VELOCITY else 1.0 for c in rest])
        factors.append(
            gaussian_factors(keys, [H], np.zeros((len(keys), len(rest))), np.tile(variance, (len(keys), 1, 1)))
        )
    return factors


def detection_loss(settings: JointSettings) -> Robust | None:
    """The robust loss of detections, None where the settings have none."""
    return None if np.isinf(settings.outlier_scale) else Robust("cauchy", settings.outlier_scale)


def detections(record: Record, settings: JointSettings) -> list[ResidualFactors]:
    """Detections of objects, from the vehicle's pose."""
    robust = detection_loss(settings)
    rows = list[tuple[Any, ...]]()
    for now in record:
        types = now.objects.types[np.searchsorted(now.objects.id, now.seen.id)]
        names = now.seen.id.tolist()
        keys = [(pose_key(now.epoch), object_key(now.epoch, name)) for name in names]
        rows += zip(types, keys, now.seen.z, now.seen.R, strict=True)
    return [
        relative_factors(keys.astype(np.uint64), z, R, node_type.dim, node_type.index(POSITION).tolist(), robust)
        for node_type, (keys, z, R) in _by_type(rows)
    ]


def stationary_factors(record: Record, stationary: Sequence[FloatArray]) -> list[ResidualFactors]:
    """Between two epochs of an object that may be stationary at both; stationary: probabilities (n,) of each."""
    rows = list[tuple[Any, ...]]()
    for (before, p_before), (now, p_now) in pairwise(zip(record, stationary, strict=True)):
        names, here, there = np.intersect1d(now.objects.id, before.objects.id, return_indices=True)
        p = np.minimum(p_now[here], p_before[there])
        for row in np.flatnonzero(p > LIKELY).tolist():
            both = [object_key(epoch, int(names[row])) for epoch in (before.epoch, now.epoch)]
            rows.append((now.objects.types[here[row]], both, p[row], now.time - before.time))
    factors: list[ResidualFactors] = []
    for node_type, (keys, p, dt) in _by_type(rows):
        at, speeds = node_type.selector(POSITION), node_type.selector(VELOCITY)
        model = _Linear(np.concatenate([-at, 0 * speeds]), np.concatenate([at, speeds]))  # (p' - p, v')
        drift, speed = STATIONARY_DRIFT**2 * dt, np.full(len(dt), STATIONARY_SPEED**2)
        factors.append(
            ResidualFactors(
                keys.astype(np.uint64),
                (node_type.dim, node_type.dim),
                model.residual,
                np.stack([drift, drift, speed, speed], axis=1)[:, :, None] * np.eye(4),
                model.jacobians,
                Mixture(p),
                name="stationary objects",
            )
        )
    return factors


@dataclass(frozen=True, eq=False)
class _Linear:
    """B x + C x' of states (N, dim) at two epochs."""

    B: FloatArray
    C: FloatArray

    def residual(self, before: FloatArray, now: FloatArray) -> FloatArray:
        return np.asarray(before @ self.B.T + now @ self.C.T)

    def jacobians(self, before: FloatArray, now: FloatArray) -> Sequence[FloatArray]:
        return [np.tile(each, (len(now), 1, 1)) for each in (self.B, self.C)]


@dataclass(frozen=True, eq=False)
class ObjectStates:
    """Objects of an epoch: id (n,), n classes, position (n, 2), m, and velocity (n, 2), m/s, in the world.

    stationary  (n,) probability of being at rest
    """

    id: IntArray
    label: tuple[str, ...]
    position: FloatArray
    velocity: FloatArray
    stationary: FloatArray


@dataclass(frozen=True, eq=False)
class JointEstimate:
    """Estimate at n epochs.

    timestamps    (n,) s
    world_T_ego   (n, 4, 4)
    errors        (n, 3) of the odometry: scale, bias of the yaw rate (rad/s), course (rad)
    objects       n tables
    converged     whether the last step was short enough
    solution      of the graph, with the keys of this module
    """

    timestamps: FloatArray
    world_T_ego: FloatArray
    errors: FloatArray
    objects: tuple[ObjectStates, ...]
    converged: bool
    solution: Solution
    _record: Record

    @cached_property
    def pose_covariances(self) -> FloatArray:
        """(n, 6, 6) of each pose, in its own frame: rotation vector (rad), translation (m)."""
        return np.stack([self.solution.marginal(pose_key(now.epoch)) for now in self._record])

    def object_covariances(self, row: int) -> FloatArray:
        """(n, 4, 4) of position and velocity of the objects of a row of the estimate."""
        now = self._record[row]
        result = np.empty((len(now.objects.id), 4, 4))
        for k, (name, node_type) in enumerate(zip(now.objects.id.tolist(), now.objects.types, strict=True)):
            at = node_type.index(POSITION + VELOCITY)
            result[k] = self.solution.marginal(object_key(now.epoch, name))[at[:, None], at]
        return result

    def assignment(self, row: int) -> Assignment:
        """Objects and their detections at a row of the estimate."""
        seen = self._record[row].seen
        return Assignment(seen.id, seen.row)

    @cached_property
    def slow_errors(self) -> FloatArray:
        """Deviations (3,) of the odometry's slow errors: mean over the first, the middle and the last epoch."""
        n = len(self._record)
        P = np.stack([self.solution.marginal(error_key(self._record[row].epoch)) for row in (0, n // 2, n - 1)])
        return np.asarray(np.sqrt(np.diagonal(P, axis1=1, axis2=2).mean(axis=0)))


def read_estimate(record: Record, solution: Solution, stationary: Sequence[FloatArray]) -> JointEstimate:
    """The estimate at the epochs of a record; stationary: probabilities (n,) of the objects of each."""
    values = solution.values
    return JointEstimate(
        timestamps=np.array([now.time for now in record]),
        world_T_ego=np.stack([values.atPose3(pose_key(now.epoch)).matrix() for now in record]),
        errors=np.stack([values.atVector(error_key(now.epoch)) for now in record]),
        objects=tuple(_objects(now, values, p) for now, p in zip(record, stationary, strict=True)),
        converged=solution.converged,
        solution=solution,
        _record=record,
    )


def _objects(now: RecordedEpoch, values: gtsam.Values, stationary: FloatArray) -> ObjectStates:
    objects = now.objects
    state = np.zeros((len(objects.id), 4))
    for row, (name, node_type) in enumerate(zip(objects.id.tolist(), objects.types, strict=True)):
        state[row] = values.atVector(object_key(now.epoch, name))[node_type.index(POSITION + VELOCITY)]
    return ObjectStates(objects.id, tuple(objects.label.tolist()), state[:, :2], state[:, 2:], stationary)


@dataclass(frozen=True, eq=False)
class VehicleAndObjects:
    """Add the epochs of `record`, one a frame.

    path: expected poses (4, 4) of all. Odometry and detections come with the last epoch, so that all are
    linearised together.
    """

    record: Record
    path: Sequence[FloatArray] | FloatArray
    settings: JointSettings
    name: str = "vehicle and objects"

    def factors(self, view: GraphView) -> Additions:
        row = view.epoch - self.record[0].epoch
        now, pose, k = self.record[row], self.path[row], view.epoch
        slow = view.state(error_key(k - 1)) if k else np.zeros(ERROR_DIM)
        new = [NewVariable(EGO_POSE, 0, gtsam.Pose3(pose), label="vehicle"), NewVariable(EGO_ERROR, 0, slow)]
        moved = Additions() if now.transition is None else Interactions(now.transition).factors(view)
        states = {variable.id: variable.state for variable in moved.variables}
        seen = dict(zip(now.seen.id.tolist(), transform_points(pose, now.seen.z)[:, :2], strict=True))
        objects = now.objects
        for name, kind, label in zip(objects.id.tolist(), objects.types, objects.label.tolist(), strict=True):
            state = np.array(states.get(name, np.zeros(kind.dim)))
            if name in seen:
                state[kind.index(POSITION)] = seen[name]
            new.append(NewVariable(OBJECT, name, state, label=label))
        factors: list[Factor] = [*_priors(k, objects.select(~np.isin(objects.id, list(states))))]
        if k == 0:
            errors = np.diag(np.square(self.settings.odometry.slow))
            factors.append(prior_factor(error_key(k), np.zeros(ERROR_DIM), errors))
            factors.append(pose_prior_factor(pose_key(k), pose, START_NOISE**2 * np.eye(6)))
        if row + 1 == len(self.record):
            factors += odometry(self.record, self.settings)
            factors += detections(self.record, self.settings)
        return Additions(new, factors, moved.named)


TOLERANCE = 1.0  # standard deviations of the last step, over all variables together


def estimate_jointly(
    frames: Sequence[Frame],
    odometry: OdometryIncrements,
    new_tracker: Callable[[], Tracker],
    settings: JointSettings | None = None,
    start: FloatArray | None = None,
    new_providers: Callable[[], Sequence[FactorProvider]] = tuple,
) -> JointEstimate:
    """Estimate the path (n poses) and the objects of n frames, in increasing order of time.

    odometry: between the frames' times; new_tracker: gives a new tracker, which associates detections; start: first
    pose (4, 4), by default the identity; new_providers: gives new providers of other factors, asked with each frame
    (`saga_fg.slam.mapping.LandmarkObservations` for landmarks). Detections are in ego or sensor coordinates, or in
    those of the world with the pose they were transformed by. Raises `InputError` where frames and odometry do not fit
    together.
    """
    settings = settings or JointSettings()
    times = np.array([frame.timestamp for frame in frames])
    if len(times) != len(odometry) or not np.allclose(times, odometry.timestamps, atol=1e-6):
        raise InputError(f"frames: expected one at each of the {len(odometry)} times of the odometry, got {len(times)}")
    path = odometry.path(start)
    slow = settings.odometry.slow
    estimate = None
    links: list[list[int]] = []
    for _ in range(settings.passes):
        tracker = new_tracker()
        record = record_epochs(frames, path, odometry, tracker)
        before, links = links, [now.seen.id.tolist() for now in record]
        if links == before:
            break
        start_moving = estimate is None
        epochs = VehicleAndObjects(record, path, settings)
        estimate = _solve(epochs, frames, slow, start_moving, new_providers())
        path, slow = estimate.world_T_ego, estimate.slow_errors
    assert estimate is not None
    return estimate


def _solve(
    epochs: VehicleAndObjects,
    frames: Sequence[Frame],
    slow: FloatArray,
    start_moving: bool,
    providers: Sequence[FactorProvider],
) -> JointEstimate:
    """Solve the epochs of a record several times, each from the solution before: if `start_moving` with all objects
    moving, which needs no good start; then with those stationary that seem so along the path.
    """
    graph, solver = SceneFactorGraph(), SolverSettings(max_iterations=MAX_ITERATIONS, tolerance=TOLERANCE)
    record, settings = epochs.record, epochs.settings
    for now, frame in zip(record, frames, strict=True):
        graph.advance(now.time)
        ask_all([epochs, *providers], graph, frame)
    if start_moving:
        graph.solve(solver)
    probabilities = stationary_probabilities(record, np.asarray(epochs.path), slow, settings)
    name = "stationary objects"
    graph.add_factors(name, stationary_factors(record, probabilities), name)
    return read_estimate(record, graph.solve(solver), probabilities)

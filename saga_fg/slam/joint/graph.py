"""The vehicle's path and the objects around it, from a whole recording: factors of a record, and their solution.

Factors of a record: poses of the vehicle, errors of its odometry, and states of objects, over time.

    prior        first pose; first errors; velocity of a new object
    odometry     poses and errors of two epochs            (`factors.poses`)
    interaction  an object's next state and the states of all that act on it
    detection    a pose and an object's state              (`factors.poses`), robust
    stationary   p' - p ~ N(0, stationary_drift^2 dt),  v' ~ N(0, stationary_speed^2)     with probability P

The last one is the hybrid part of the model. With the probability P (`saga_fg.slam.joint.association`) an object is
stationary and a landmark, else it moves as its class does and the factor is silent: a mixture (`factors.Mixture`). A
variable is a `gtsam.Pose3` for the vehicle and a vector for everything else.

Providers add them, for a whole recording or a window of epochs.

Discrete unknowns depend on the path: the association of detections, and the stationarity of objects. A pass associates
along the path so far, starting with the odometry's, takes the probabilities of stationarity from the detections, and
solves the graph of all epochs. Passes end when associations repeat.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

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
    interaction_factor,
    odometry_factors,
    prior_factor,
    relative_factors,
)
from saga_fg.errors import InputError
from saga_fg.estimators import GraphSolution
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
from saga_fg.slam.joint.association import SlowErrors, stationary_probabilities
from saga_fg.slam.joint.record import (
    MAX_ITERATIONS,
    JointSettings,
    OdometryIncrements,
    RecordedEpoch,
    RecordedObjects,
    motion_covariances,
    record_epochs,
)
from saga_fg.slam.mapping import pose_key
from saga_fg.tracking import Tracker
from saga_fg.types import Frame

_START_NOISE = 1e-3  # standard deviation of the first pose, m and rad
_LIKELY = 0.9  # stationary with less than this probability: no such factor, since creeping queues are in doubt, too
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


def start_factors(
    epoch: int, world_T_ego: FloatArray, settings: JointSettings
) -> tuple[gtsam.JacobianFactor, gtsam.NonlinearFactor]:
    """Priors of the odometry's errors and of the first pose, which fixes the world frame."""
    noise = settings.odometry
    slow = prior_factor(error_key(epoch), np.zeros(ERROR_DIM), np.diag([noise.scale, noise.bias, noise.course]) ** 2)
    sigma = gtsam.noiseModel.Isotropic.Sigma(6, _START_NOISE)
    return slow, gtsam.PriorFactorPose3(pose_key(epoch), gtsam.Pose3(world_T_ego), sigma)


def new_object_factors(now: RecordedEpoch, known: set[int]) -> list[GaussianFactors]:
    """Priors of new objects; known: ids of the objects of the epoch before."""
    new = np.flatnonzero(~np.isin(now.objects.id, np.array(sorted(known), dtype=np.int64)))
    return _priors(now.epoch, now.objects.select(new))


def odometry(record: Record, settings: JointSettings) -> list[ResidualFactors]:
    """Poses and slow errors of consecutive epochs."""
    if len(record) < 2:
        return []
    pairs = [(before.epoch, now.epoch) for before, now in pairwise(record)]
    rows = np.array([[pose_key(j), pose_key(k), error_key(j), error_key(k)] for j, k in pairs], dtype=np.uint64)
    steps = np.stack([now.a_T_b for now in record[1:]])
    dt = np.diff([now.time for now in record])
    return [odometry_factors(rows, steps, dt, motion_covariances(record, settings))]


def _priors(k: int, new: RecordedObjects) -> list[GaussianFactors]:
    """All components of new objects but the position: unknown velocities, and others, N(0, 1).

    The usual motion of a class must not be a prior of each object: in traffic all go the same way, and a hundred small
    errors of one sign would pull at the vehicle.
    """
    factors = []
    for node_type, mine in by_type(new.types):
        rest = [c for c in node_type.components if c not in POSITION]
        H = node_type.selector(rest)
        deviation = np.ones((len(mine), len(rest)))
        deviation[:, [rest.index(c) for c in VELOCITY]] = _ANY_SPEED
        keys = np.array([[object_key(k, int(name))] for name in new.id[mine]], dtype=np.uint64)
        blocks = np.broadcast_to(H, (len(mine), *H.shape))
        covariances = deviation[:, :, None] ** 2 * np.eye(len(rest))
        factors.append(gaussian_factors(keys, [blocks], np.zeros(deviation.shape), covariances))
    return factors


def detections(record: Record, settings: JointSettings) -> list[ResidualFactors]:
    """Detections of objects, from the vehicle's pose."""
    robust = None if np.isinf(settings.outlier_scale) else Robust("cauchy", settings.outlier_scale)
    collected: dict[NodeType, list[tuple[int, int, FloatArray, FloatArray]]] = {}
    for now in record:
        types = dict(zip(now.objects.id.tolist(), now.objects.types, strict=True))
        for name, z, R in zip(now.seen.id.tolist(), now.seen.z, now.seen.R, strict=True):
            collected.setdefault(types[name], []).append((pose_key(now.epoch), object_key(now.epoch, name), z, R))
    factors: list[ResidualFactors] = []
    for node_type, rows in collected.items():
        x, y = node_type.index(POSITION).tolist()
        pose, thing, z, R = (np.array(column) for column in zip(*rows, strict=True))
        keys = np.column_stack([pose, thing]).astype(np.uint64)
        factors.append(relative_factors(keys, z, R, node_type.dim, (x, y), robust))
    return factors


def stationary_factors(record: Record, stationary: Sequence[FloatArray]) -> list[ResidualFactors]:
    """Between two epochs of an object that may be stationary at both; stationary: probabilities (n,) of each."""
    collected: dict[NodeType, list[tuple[int, int, float, float]]] = {}
    for (before, p_before), (now, p_now) in pairwise(zip(record, stationary, strict=True)):
        names, here, there = np.intersect1d(now.objects.id, before.objects.id, return_indices=True)
        p = np.minimum(p_now[here], p_before[there])
        for row in np.flatnonzero(p > _LIKELY).tolist():
            name, node_type = int(names[row]), now.objects.types[int(here[row])]
            keys = object_key(before.epoch, name), object_key(now.epoch, name)
            collected.setdefault(node_type, []).append((*keys, float(p[row]), now.time - before.time))
    factors: list[ResidualFactors] = []
    for node_type, rows in collected.items():
        model = _StationaryResidual(node_type.dim, tuple(node_type.index(POSITION)), tuple(node_type.index(VELOCITY)))
        first, second, p, dt = (np.array(column) for column in zip(*rows, strict=True))
        drift, speed = STATIONARY_DRIFT**2 * dt, np.full(len(dt), STATIONARY_SPEED**2)
        factors.append(
            ResidualFactors(
                np.column_stack([first, second]).astype(np.uint64),
                (node_type.dim, node_type.dim),
                model.residual,
                np.stack([drift, drift, speed, speed], axis=1)[:, :, None] * np.eye(4),
                model.jacobians,
                Mixture(p),
                name="stationary objects",
            )
        )
    return factors


@dataclass(frozen=True)
class _StationaryResidual:
    """(p' - p, v') of states (N, dim)."""

    dim: int
    position: tuple[int, ...]
    velocity: tuple[int, ...]

    def residual(self, before: FloatArray, now: FloatArray) -> FloatArray:
        at_p, at_v = list(self.position), list(self.velocity)
        return np.concatenate([now[:, at_p] - before[:, at_p], now[:, at_v]], axis=1)

    def jacobians(self, before: FloatArray, now: FloatArray) -> Sequence[FloatArray]:
        J_before, J_now = np.zeros((2, len(now), 4, self.dim))
        J_before[:, [0, 1], list(self.position)] = -1.0
        J_now[:, [0, 1, 2, 3], [*self.position, *self.velocity]] = 1.0
        return [J_before, J_now]


def by_type(types: Sequence[NodeType]) -> list[tuple[NodeType, np.ndarray[tuple[int], np.dtype[np.int64]]]]:
    """Rows of equal node type, with the type."""
    rows: dict[NodeType, list[int]] = {}
    for row, node_type in enumerate(types):
        rows.setdefault(node_type, []).append(row)
    return [(node_type, np.array(mine, dtype=np.int64)) for node_type, mine in rows.items()]


def motion_factors(now: RecordedEpoch) -> list[gtsam.JacobianFactor]:
    """Motion and interactions from the epoch before.

    Raises `InputError` for motions and interactions that are not linear.
    """
    transition, k = now.transition, now.epoch
    if transition is None:
        return []
    if transition.graph.nonlinear or any(node_type.flow is not None for node_type in transition.graph.types):
        raise InputError("motion: expected linear motion and interactions of objects beside a vehicle's path")
    factors, names = list[gtsam.JacobianFactor](), transition.nodes.tolist()
    sources: list[list[tuple[int, FloatArray]]] = [[] for _ in names]
    for blocks in transition.F:
        for i, j, F in zip(blocks.target.tolist(), blocks.source.tolist(), blocks.values, strict=True):
            sources[i].append((object_key(k - 1, names[j]), F))
    for blocks in transition.Q:
        for i, Q in zip(blocks.target.tolist(), blocks.values, strict=True):
            keys, F = [key for key, _ in sources[i]], [one for _, one in sources[i]]
            b = transition.b[transition.offsets[i] : transition.offsets[i + 1]]
            factors.append(interaction_factor(object_key(k, names[i]), keys, F, b, Q))
    return factors


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
    solution: Solution | GraphSolution
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
    def slow_errors(self) -> SlowErrors:
        """Deviations of the odometry's slow errors: mean over the first, the middle and the last epoch."""
        n = len(self._record)
        P = np.stack([self.solution.marginal(error_key(self._record[row].epoch)) for row in (0, n // 2, n - 1)])
        return SlowErrors(*np.sqrt(np.diagonal(P, axis1=1, axis2=2).mean(axis=0)).tolist())


def read_estimate(
    record: Record, solution: Solution | GraphSolution, stationary: Sequence[FloatArray]
) -> JointEstimate:
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
    return ObjectStates(objects.id, objects.label, state[:, :2], state[:, 2:], stationary)


@dataclass(frozen=True, eq=False)
class VehicleAndObjects:
    """Add the epochs of `record`, one a frame, of which the graph has the first `known` already.

    path: expected poses (4, 4) of the others. Odometry and detections come with the last epoch, so that all are
    linearised together.
    """

    record: Record
    path: Sequence[FloatArray] | FloatArray
    settings: JointSettings
    known: int = 0
    name: str = "vehicle and objects"

    def factors(self, view: GraphView) -> Additions:
        row = view.epoch - self.record[0].epoch
        now, pose, k = self.record[row], self.path[row - self.known], view.epoch
        before = set(self.record[row - 1].objects.id.tolist()) if row else set()
        slow = view.state(error_key(k - 1)) if k else np.zeros(ERROR_DIM)
        new = [NewVariable(EGO_POSE, 0, gtsam.Pose3(pose), label="vehicle"), NewVariable(EGO_ERROR, 0, slow)]
        seen = dict(zip(now.seen.id.tolist(), transform_points(pose, now.seen.z)[:, :2], strict=True))
        objects = now.objects
        for name, kind, label in zip(objects.id.tolist(), objects.types, objects.label, strict=True):
            state = np.zeros(kind.dim)
            if name in before:  # at constant velocity
                state = np.array(view.state(object_key(k - 1, name)))
                state[kind.index(POSITION)] += view.dt * state[kind.index(VELOCITY)]
            if name in seen:
                state[kind.index(POSITION)] = seen[name]
            new.append(NewVariable(OBJECT, name, state, label=label))
        factors: list[Factor] = [*new_object_factors(now, before)]
        if before:
            factors += motion_factors(now)
        if k == 0:
            factors += start_factors(k, pose, self.settings)
        if row + 1 == len(self.record):
            factors += odometry(self.record[max(self.known - 1, 0) :], self.settings)
            factors += detections(self.record[self.known :], self.settings)
        return Additions(new, factors)


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
    slow = SlowErrors.at_start(settings)
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
    slow: SlowErrors,
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

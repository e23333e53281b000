"""Factors of a record: poses of the vehicle, errors of its odometry, and states of objects, over time.

    prior        first pose; first errors; velocity of a new object
    odometry     poses and errors of two epochs            (`factors.odometry`)
    interaction  an object's next state and the states of all that act on it, from the scene graph
    detection    a pose and an object's state              (`factors.relative`), robust
    stationary   p' - p ~ N(0, standing_drift^2 dt / P),  v' ~ N(0, standing_speed^2 / P), robust

The last one is the hybrid part of the model: with the probability P an object is stationary and a landmark, else it
moves and the factor is silent (see `saga_fg.slam.joint.stationarity`). A variable is a `gtsam.Pose3` for the vehicle
and a vector for everything else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np

from factors import (
    ERROR_DIM,
    Linearisable,
    ResidualFactors,
    Robust,
    gaussian_factors,
    odometry_factors,
    prior_factor,
    relative_detection_factors,
)
from saga_fg.errors import InputError
from saga_fg.estimators.interval_dynamics import IntervalDynamics
from saga_fg.estimators.layout import StateLayout
from saga_fg.estimators.object_factors import interval_factors
from saga_fg.graph import EGO_ERROR, OBJECT, key_of
from saga_fg.model.interactions import POSITION, VELOCITY
from saga_fg.model.motion import NodeType
from saga_fg.model.transition import Transition
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.joint.record import RecordedEpoch, RecordedObjects, motion_covariances
from saga_fg.slam.joint.settings import JointSettings
from saga_fg.slam.mapping import pose_key

_LIKELY = 0.9  # an object that is stationary with less than this probability gets no such factor
_SURELY_MOVING = 4.0  # standard deviations from rest at which the loss gives an object up
_ANY_SPEED = 100.0  # m/s, deviation of an unknown velocity
Record = Sequence[RecordedEpoch]


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
    sigma = gtsam.noiseModel.Isotropic.Sigma(6, settings.start_noise)
    return slow, gtsam.PriorFactorPose3(pose_key(epoch), gtsam.Pose3(world_T_ego), sigma)


def linear_factors(now: RecordedEpoch, known: set[int]) -> list[gtsam.JacobianFactor]:
    """Priors of new objects and interactions; known: ids of the objects of the epoch before, none at the first one."""
    new = np.flatnonzero(~np.isin(now.objects.id, np.array(sorted(known), dtype=np.int64)))
    priors = _priors(now.epoch, now.objects.select(new))
    return priors + _motions(now.epoch, now.transition) if known and now.transition is not None else priors


def odometry(record: Record, settings: JointSettings) -> list[Linearisable]:
    """Poses and slow errors of consecutive epochs."""
    if len(record) < 2:
        return []
    pairs = [(before.epoch, now.epoch) for before, now in pairwise(record)]
    rows = np.array([[pose_key(j), pose_key(k), error_key(j), error_key(k)] for j, k in pairs], dtype=np.uint64)
    steps = np.stack([now.a_T_b for now in record[1:]])
    dt = np.diff([now.time for now in record])
    return [odometry_factors(rows, steps, dt, motion_covariances(record, settings))]


def _priors(k: int, new: RecordedObjects) -> list[gtsam.JacobianFactor]:
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
        factors += gaussian_factors(
            keys, [blocks], np.zeros(deviation.shape), deviation[:, :, None] ** 2 * np.eye(len(rest))
        )
    return factors


def _motions(k: int, transition: Transition) -> list[gtsam.JacobianFactor]:
    """Motion and interactions from the epoch before."""
    nodes = transition.nodes.tolist()
    layout = StateLayout(nodes, transition.graph.dims)
    before, now = ({name: object_key(at, name) for name in nodes} for at in (k - 1, k))
    interval = IntervalDynamics(transition)
    if not interval.linear:
        raise InputError("motion: expected linear motion and interactions of objects beside a vehicle's path")
    return interval_factors(interval, layout, np.zeros(layout.size), before, now)[0]


def detections(record: Record, settings: JointSettings) -> list[Linearisable]:
    """Detections of objects, from the vehicle's pose."""
    robust = None if np.isinf(settings.outlier_scale) else Robust("cauchy", settings.outlier_scale)
    collected: dict[NodeType, list[tuple[int, int, FloatArray, FloatArray]]] = {}
    for now in record:
        types = dict(zip(now.objects.id.tolist(), now.objects.types, strict=True))
        for name, z, R in zip(now.seen.id.tolist(), now.seen.z, now.seen.R, strict=True):
            collected.setdefault(types[name], []).append((pose_key(now.epoch), object_key(now.epoch, name), z, R))
    factors: list[Linearisable] = []
    for node_type, rows in collected.items():
        x, y = node_type.index(POSITION).tolist()
        pose, thing, z, R = (np.array(column) for column in zip(*rows, strict=True))
        keys = np.column_stack([pose, thing]).astype(np.uint64)
        factors.append(relative_detection_factors(keys, z, R, node_type.dim, (x, y), robust))
    return factors


def stationary_factors(record: Record, stationary: Sequence[FloatArray], settings: JointSettings) -> list[Linearisable]:
    """Between two epochs of an object that is probably stationary at both; stationary: probabilities (n,) of each."""
    collected: dict[NodeType, list[tuple[int, int, FloatArray]]] = {}
    for (before, p_before), (now, p_now) in pairwise(zip(record, stationary, strict=True)):
        names, here, there = np.intersect1d(now.objects.id, before.objects.id, return_indices=True)
        p = np.minimum(p_now[here], p_before[there])
        dt = now.time - before.time
        variances = np.array([settings.stationary_drift**2 * dt] * 2 + [settings.stationary_speed**2] * 2)
        for row in np.flatnonzero(p > _LIKELY).tolist():
            name, node_type = int(names[row]), now.objects.types[int(here[row])]
            keys = object_key(before.epoch, name), object_key(now.epoch, name)
            collected.setdefault(node_type, []).append((*keys, variances / p[row]))
    factors: list[Linearisable] = []
    for node_type, rows in collected.items():
        model = _StationaryResidual(node_type.dim, tuple(node_type.index(POSITION)), tuple(node_type.index(VELOCITY)))
        first, second, R = (np.array(column) for column in zip(*rows, strict=True))
        factors.append(
            ResidualFactors(
                np.column_stack([first, second]).astype(np.uint64),
                (node_type.dim, node_type.dim),
                model.residual,
                R[:, :, None] * np.eye(4),
                model.jacobians,
                Robust("geman-mcclure", _SURELY_MOVING),
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

"""Factors of a record: poses of the vehicle, errors of its odometry, and states of objects, over time.

    prior        first pose; first errors; velocity of a new object
    odometry     poses and errors of two epochs            (`factors.odometry`)
    interaction  an object's next state and the states of all that act on it (`saga_fg.slam.joint.motion`)
    detection    a pose and an object's state              (`factors.relative`), robust
    stationary   p' - p ~ N(0, stationary_drift^2 dt),  v' ~ N(0, stationary_speed^2)     with probability P

The last two are the hybrid part of the model. With the probability P (`saga_fg.slam.joint.stationarity`) an object is
stationary and a landmark, else it moves as its class does and the factor is silent: a mixture (`factors.Mixture`). With
the probability p (`saga_fg.slam.joint.identity`) a detection is of the object that it is assigned to: it counts for a
share p of its information. A variable is a `gtsam.Pose3` for the vehicle and a vector for everything else.
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
    Mixture,
    ResidualFactors,
    Robust,
    gaussian_factors,
    odometry_factors,
    prior_factor,
    relative_detection_factors,
)
from saga_fg.graph import EGO_ERROR, OBJECT, key_of
from saga_fg.model.interactions import POSITION, VELOCITY
from saga_fg.model.motion import NodeType
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.joint.record import RecordedEpoch, RecordedObjects, motion_covariances
from saga_fg.slam.joint.settings import JointSettings
from saga_fg.slam.mapping import pose_key

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


def new_object_factors(now: RecordedEpoch, known: set[int]) -> list[gtsam.JacobianFactor]:
    """Priors of new objects; known: ids of the objects of the epoch before."""
    new = np.flatnonzero(~np.isin(now.objects.id, np.array(sorted(known), dtype=np.int64)))
    return _priors(now.epoch, now.objects.select(new))


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


def detections(record: Record, settings: JointSettings) -> list[Linearisable]:
    """Detections of objects, from the vehicle's pose."""
    robust = None if np.isinf(settings.outlier_scale) else Robust("cauchy", settings.outlier_scale)
    collected: dict[NodeType, list[tuple[int, int, FloatArray, FloatArray]]] = {}
    for now in record:
        types = dict(zip(now.objects.id.tolist(), now.objects.types, strict=True))
        R_weighed = now.seen.R / now.seen.probability[:, None, None]
        for name, z, R in zip(now.seen.id.tolist(), now.seen.z, R_weighed, strict=True):
            collected.setdefault(types[name], []).append((pose_key(now.epoch), object_key(now.epoch, name), z, R))
    factors: list[Linearisable] = []
    for node_type, rows in collected.items():
        x, y = node_type.index(POSITION).tolist()
        pose, thing, z, R = (np.array(column) for column in zip(*rows, strict=True))
        keys = np.column_stack([pose, thing]).astype(np.uint64)
        factors.append(relative_detection_factors(keys, z, R, node_type.dim, (x, y), robust))
    return factors


def stationary_factors(record: Record, stationary: Sequence[FloatArray]) -> list[Linearisable]:
    """Between two epochs of an object that may be stationary at both; stationary: probabilities (n,) of each."""
    collected: dict[NodeType, list[tuple[int, int, float, float]]] = {}
    for (before, p_before), (now, p_now) in pairwise(zip(record, stationary, strict=True)):
        names, here, there = np.intersect1d(now.objects.id, before.objects.id, return_indices=True)
        p = np.minimum(p_now[here], p_before[there])
        for row in np.flatnonzero(p > _LIKELY).tolist():
            name, node_type = int(names[row]), now.objects.types[int(here[row])]
            keys = object_key(before.epoch, name), object_key(now.epoch, name)
            collected.setdefault(node_type, []).append((*keys, float(p[row]), now.time - before.time))
    factors: list[Linearisable] = []
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

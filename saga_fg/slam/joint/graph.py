"""The factor graph of a record: poses of the vehicle, errors of its odometry, and the states of objects, over time.

    prior        first pose; first errors; velocity of an object when it appears
    odometry     poses and errors of two moments          (`factors.odometry`)
    interaction  an object's next state and the states of all that act on it, from the scene graph
    detection    a pose and an object's state              (`factors.relative_detection`), robust
    standing     p' - p ~ N(0, standing_drift^2 dt / P),  v' ~ N(0, standing_speed^2 / P), robust

The last one is the hybrid part of the model: with the probability P an object stands and is a landmark, else it moves
and the factor is silent (see `saga_fg.slam.joint.standing`). A variable is a `gtsam.Pose3` for the vehicle and a vector
for everything else.
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
from saga_fg.estimators.factor_graph import interval_factors
from saga_fg.estimators.interval_dynamics import IntervalDynamics
from saga_fg.estimators.layout import Layout
from saga_fg.graph import EGO_ERROR, OBJECT, key_of
from saga_fg.model.interactions import POSITION, VELOCITY
from saga_fg.model.node import NodeType
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.joint.record import EgoMoment, motion_covariances
from saga_fg.slam.joint.settings import JointSettings
from saga_fg.slam.mapping import pose_key

_LIKELY = 0.9  # an object that stands with less than this probability is taken to move
_SURELY_MOVING = 4.0  # standard deviations from standing at which the loss gives up an object
_ANY_SPEED = 100.0  # m/s, deviation of a velocity of which nothing is known
Keyed = list[tuple[int, EgoMoment]]


def error_key(moment: int) -> int:
    """Key of the odometry's slow errors (scale, bias of the yaw rate, course) at a moment."""
    return key_of(EGO_ERROR, 0, moment)


def object_key(moment: int, name: int) -> int:
    """Key of an object's state at a moment."""
    return key_of(OBJECT, name, moment)


def start_factors(
    moment: int, world_T_ego: FloatArray, settings: JointSettings
) -> tuple[gtsam.JacobianFactor, gtsam.NonlinearFactor]:
    """Priors of the odometry's errors and of the first pose, which says where the world lies."""
    noise = settings.odometry
    slow = prior_factor(error_key(moment), np.zeros(ERROR_DIM), np.diag([noise.scale, noise.bias, noise.course]) ** 2)
    sigma = gtsam.noiseModel.Isotropic.Sigma(6, settings.start_noise)
    return slow, gtsam.PriorFactorPose3(pose_key(moment), gtsam.Pose3(world_T_ego), sigma)


def linear_factors(k: int, moment: EgoMoment, known: set[int]) -> list[gtsam.JacobianFactor]:
    """Births and interactions of one moment; known: ids of the objects of the moment before, none at the first one."""
    new = np.flatnonzero(~np.isin(moment.objects.id, np.array(sorted(known), dtype=np.int64)))
    births = _births(k, moment, new)
    return births + _motions(k, moment) if known and moment.transition is not None else births


def odometry(record: Keyed, settings: JointSettings) -> list[Linearisable]:
    """Poses and slow errors of consecutive moments."""
    if len(record) < 2:
        return []
    pairs = [(j, k) for (j, _), (k, _) in pairwise(record)]
    rows = np.array([[pose_key(j), pose_key(k), error_key(j), error_key(k)] for j, k in pairs], dtype=np.uint64)
    steps = np.stack([moment.a_T_b for _, moment in record[1:]])
    dt = np.diff([moment.time for _, moment in record])
    noise = motion_covariances([moment for _, moment in record], settings)
    return [odometry_factors(rows, steps, dt, noise)]


def _births(k: int, moment: EgoMoment, rows: np.ndarray[tuple[int], np.dtype[np.int64]]) -> list[gtsam.JacobianFactor]:
    """All components but the position of new objects: velocities, of which nothing is known, and others, N(0, 1).

    What a class of objects usually does must not be told of each: in traffic they all go the same way, and a hundred
    small errors of one sign would pull at the vehicle.
    """
    born = moment.objects.select(rows)
    factors = []
    for node_type, mine in by_type(born.types):
        rest = [c for c in node_type.components if c not in POSITION]
        H = node_type.selector(rest)
        deviation = np.ones((len(mine), len(rest)))
        deviation[:, [rest.index(c) for c in VELOCITY]] = _ANY_SPEED
        keys = np.array([[object_key(k, int(name))] for name in born.id[mine]], dtype=np.uint64)
        blocks = np.broadcast_to(H, (len(mine), *H.shape))
        factors += gaussian_factors(
            keys, [blocks], np.zeros(deviation.shape), deviation[:, :, None] ** 2 * np.eye(len(rest))
        )
    return factors


def _motions(k: int, moment: EgoMoment) -> list[gtsam.JacobianFactor]:
    """Interactions from the moment before."""
    assert moment.transition is not None
    nodes = moment.transition.nodes.tolist()
    layout = Layout(nodes, moment.transition.graph.dims)
    before = {name: object_key(k - 1, name) for name in nodes}
    now = {name: object_key(k, name) for name in nodes}
    interval = IntervalDynamics(moment.transition)
    if not interval.linear:
        raise InputError("motion: expected linear motion and interactions of objects beside a vehicle's path")
    return interval_factors(interval, layout, np.zeros(layout.size), before, now)[0]


def detections(record: Keyed, settings: JointSettings) -> list[Linearisable]:
    """Objects seen from the vehicle."""
    collected: dict[NodeType, _Rows] = {}
    for k, moment in record:
        types = dict(zip(moment.objects.id.tolist(), moment.objects.types, strict=True))
        for node_type, mine in by_type(tuple(types[name] for name in moment.seen.id.tolist())):
            rows = collected.setdefault(node_type, _Rows([], [], []))
            rows.keys += [[pose_key(k), object_key(k, int(name))] for name in moment.seen.id[mine]]
            rows.z.append(moment.seen.z[mine])
            rows.R.append(moment.seen.R[mine])
    factors: list[Linearisable] = []
    for node_type, rows in collected.items():
        x, y = node_type.index(POSITION).tolist()
        keys, z, R = np.array(rows.keys, dtype=np.uint64), np.concatenate(rows.z), np.concatenate(rows.R)
        factors.append(relative_detection_factors(keys, z, R, node_type.dim, (x, y), _robust(settings)))
    return factors


@dataclass
class _Rows:
    keys: list[list[int]]
    z: list[FloatArray]
    R: list[FloatArray]


def standing_factors(record: Keyed, standing: Sequence[FloatArray], settings: JointSettings) -> list[Linearisable]:
    """Between two moments of an object that probably stands at both."""
    collected: dict[NodeType, _Rows] = {}
    told = list(zip(record, standing, strict=True))
    for ((j, before), p_before), ((k, now), p_now) in pairwise(told):
        names, here, there = np.intersect1d(now.objects.id, before.objects.id, return_indices=True)
        p = np.minimum(p_now[here], p_before[there])
        likely = p > _LIKELY
        dt = now.time - before.time
        types = tuple(now.objects.types[row] for row in here[likely].tolist())
        variances = np.array([settings.standing_drift**2 * dt] * 2 + [settings.standing_speed**2] * 2)
        for node_type, mine in by_type(types):
            rows = collected.setdefault(node_type, _Rows([], [], []))
            rows.keys += [[object_key(j, name), object_key(k, name)] for name in names[likely][mine].tolist()]
            rows.R.append(variances / p[likely][mine, None])
    factors: list[Linearisable] = []
    for node_type, rows in collected.items():
        model = _Standing(node_type.dim, tuple(node_type.index(POSITION)), tuple(node_type.index(VELOCITY)))
        factors.append(
            ResidualFactors(
                np.array(rows.keys, dtype=np.uint64),
                (node_type.dim, node_type.dim),
                model.residual,
                np.concatenate(rows.R)[:, :, None] * np.eye(4),
                model.jacobians,
                Robust("geman-mcclure", _SURELY_MOVING),
                name="standing objects",
            )
        )
    return factors


@dataclass(frozen=True)
class _Standing:
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


def _robust(settings: JointSettings) -> Robust | None:
    return None if np.isinf(settings.outlier_scale) else Robust("cauchy", settings.outlier_scale)


def by_type(types: Sequence[NodeType]) -> list[tuple[NodeType, np.ndarray[tuple[int], np.dtype[np.int64]]]]:
    """Rows of equal node type, with the type."""
    rows: dict[NodeType, list[int]] = {}
    for row, node_type in enumerate(types):
        rows.setdefault(node_type, []).append(row)
    return [(node_type, np.array(mine, dtype=np.int64)) for node_type, mine in rows.items()]

"""Are the smoother's covariances right? Recordings drawn from the very model that the smoother is told of.

Groups of three objects share their velocities; association is known. The root mean square of the error in the middle of
each group's time, one object a group and so one independent sample, is compared with what the covariances say:

    predicted^2 = mean over the samples of tr P / 2        of a component of the position
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from saga_fg.estimators import BatchSmoother, Measurements
from saga_fg.model.discretisation import discretise
from saga_fg.model.node import ConstantVelocity, NodeType
from saga_fg.model.scene_graph import Edges, SceneGraph
from saga_fg.model.transition import Transition
from saga_fg.numerics.arrays import FloatArray

GROUP = 3  # objects that act on each other
GROUPS_AT_A_TIME = 50
STEPS = 20
INTERVAL = 0.5  # s
RATE = 0.4  # of every edge within a group, 1/s
NOISE = 0.4  # standard deviation of a measured position, m
SEEN = 0.8  # chance of a measurement
PRIOR = np.diag([1.0, 1.0, 4.0, 4.0])  # of a position and a velocity at the start, m^2 and (m/s)^2


@dataclass(frozen=True)
class DrawnFit:
    """Independent samples, and root mean squares of a position component, m: measured and as predicted."""

    samples: int
    measured: float
    predicted: float

    @property
    def ratio(self) -> float:
        """Measured over predicted: 1 if the covariances are right."""
        return self.measured / self.predicted


def drawn_fit(samples: int, seed: int = 0) -> DrawnFit:
    """Draw and smooth as many groups as samples are wanted, some at a time."""
    rng = np.random.default_rng(seed)
    errors, traces = [], []
    for first in range(0, samples, GROUPS_AT_A_TIME):
        error, P = _smoothed_groups(min(GROUPS_AT_A_TIME, samples - first), rng)
        errors.append(error)
        traces.append(np.trace(P, axis1=1, axis2=2) / 2)
    measured = float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))
    return DrawnFit(samples, measured, float(np.sqrt(np.concatenate(traces).mean())))


def _smoothed_groups(groups: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Errors (groups, 2) of the positions in the middle of the recording, and their covariances (groups, 2, 2)."""
    nodes = np.arange(GROUP * groups)
    graph = _groups_that_share_velocity(groups)
    H, R = graph.types[0].selector(("x", "y")), NOISE**2 * np.eye(2)
    start = np.concatenate([rng.uniform(0, 100, (len(nodes), 2)), np.zeros((len(nodes), 2))], axis=1)
    truth = start + rng.multivariate_normal(np.zeros(4), PRIOR, len(nodes))
    smoother = BatchSmoother(likelihoods=False)
    smoother.add(nodes, start, np.tile(PRIOR, (len(nodes), 1, 1)))
    move = discretise(graph, INTERVAL)
    for k in range(STEPS):
        if k:
            truth = _moved(truth, move, rng)
            smoother.predict(move)
        if k == STEPS // 2:
            middle = truth
        seen = np.flatnonzero(rng.random(len(nodes)) < SEEN)
        smoother.update(Measurements(seen, truth[seen, :2] + rng.normal(0, NOISE, (len(seen), 2)), H, R))
    one = nodes[::GROUP]  # the others of its group are not independent of it
    smoothed = smoother.smoothed()[STEPS // 2]
    return (smoothed.mean(one) - middle[one])[:, :2], smoothed.covariance(one)[:, :2, :2]


def _groups_that_share_velocity(groups: int) -> SceneGraph:
    """Every object relaxes towards the velocities of the others of its group."""
    within = [(i, j) for i in range(GROUP) for j in range(GROUP) if i != j]
    pairs = (GROUP * np.arange(groups)[:, None, None] + np.array(within)).reshape(-1, 2)
    pull = np.tile(np.diag([0.0, 0.0, 1.0, 1.0]), (len(pairs), 1, 1))
    rate, b = np.full(len(pairs), RATE), np.zeros((len(pairs), 4))
    edges = Edges("shared velocity", pairs[:, 0], pairs[:, 1], rate, -pull, pull, b)
    return SceneGraph.of(np.arange(GROUP * groups), NodeType("object", ConstantVelocity(0.5)), (edges,))


def _moved(state: FloatArray, move: Transition, rng: np.random.Generator) -> FloatArray:
    """States (n, 4) one interval later, process noise drawn."""
    noise = np.zeros_like(state)
    for blocks in move.Q:
        drawn = rng.normal(size=(len(blocks.target), 4, 1))
        noise[blocks.target] = (np.linalg.cholesky(blocks.values) @ drawn)[..., 0]
    return np.asarray((move.F_matrix @ state.ravel() + move.b).reshape(state.shape) + noise)

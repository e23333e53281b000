"""Flocks in the plane: nodes that move, each interacting with its nearest neighbours, and data drawn from the model."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from saga_fg import Edges, SceneGraph
from saga_fg.estimators import Measurements
from saga_fg.model.discretisation import discretise
from tests.saga_fg.random_graphs import CAR


@dataclass
class Frame:
    """transition (None for the first frame) and measurements told to a filter; truth (n, 4)."""

    transition: object
    measurements: Measurements
    truth: np.ndarray


def prior_deviation():
    """Standard deviations (4,) of the initial state of a node."""
    return np.array([0.5, 0.5, 1.0, 1.0])


def flock(seed, n, frames, mixing=0.35, dt=0.1, speed=2.0, neighbours=4, missed=0.1):
    """Priors (n, 4) and frames.

    `mixing`: share of its velocity that a node takes over from its neighbours in a step. Who interacts follows from
    points that drift at `speed`, whatever the truth does: the edges are inputs, as they are to a filter.
    """
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 10 * np.sqrt(n), (n, 2))
    drift = speed * rng.normal(size=(n, 2))
    truth = np.concatenate([points, drift], axis=1)
    prior = truth + prior_deviation() * rng.normal(size=truth.shape)
    record = []
    for _ in range(frames):
        points = points + drift * dt
        source = cKDTree(points).query(points, neighbours + 1)[1][:, 1:].ravel()
        target = np.repeat(np.arange(n), neighbours)
        rate = rng.uniform(0.5, 1.5, len(target)) * -np.log(1 - mixing) / dt / neighbours
        A = np.tile(np.diag([0.0, 0.0, 1.0, 1.0]), (len(target), 1, 1))
        edges = Edges("shared velocity", target, source, rate, -A, A, np.zeros((len(target), 4)))
        transition = discretise(SceneGraph.of(np.arange(n), CAR, [edges]), dt)
        truth = (transition.F_matrix @ truth.ravel() + transition.b).reshape(n, 4)
        for blocks in transition.Q:
            noise = np.linalg.cholesky(blocks.values) @ rng.normal(size=(len(blocks.target), 4, 1))
            truth[blocks.target] += noise[:, :, 0]
        seen = np.flatnonzero(rng.random(n) >= missed)
        z = truth[seen, :2] + 0.3 * rng.normal(size=(len(seen), 2))
        record.append(Frame(transition, Measurements(seen, z, np.eye(2, 4), 0.09 * np.eye(2)), truth))
    return prior, record

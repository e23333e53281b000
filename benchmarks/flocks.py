"""Flocks: nodes that interact by shared velocity, with data sampled from the model itself.

    connected   points drift in the plane, every node listens to the four nearest, chosen anew at every frame
    components  groups of five, in which everybody listens to most of the others, to others at every frame

`mixing` is the share of its velocity that a node takes over from its neighbours in a frame: 0.2 is weak, 0.35 moderate,
0.5 strong coupling. Positions are measured, one in ten is missed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from saga_fg import ConstantVelocity, Edges, NodeType, SceneGraph
from saga_fg.estimators import Measurements
from saga_fg.model import Transition, discretise
from saga_fg.numerics import FloatArray, IntArray

Kind = Literal["connected", "components"]

DT = 0.1  # s between frames
GROUP = 5  # nodes in a component
NOISE = 0.3  # standard deviation of a measured position, m
MISSED = 0.1  # share of the nodes that are not seen in a frame
NEIGHBOURS = 4
SPACING = 10.0  # m
SPEED = 2.0  # with which the flock drifts apart, m/s
CAR = NodeType("car", ConstantVelocity(acceleration_noise=1.0))


@dataclass(frozen=True, eq=False)
class FlockFrame:
    """An interval and what is seen at its end; truth (n, 4) there."""

    transition: Transition
    measurements: Measurements
    truth: FloatArray


@dataclass(frozen=True, eq=False)
class Flock:
    """nodes (n,), prior means (n, 4) and covariances (n, 4, 4), frames."""

    kind: Kind
    nodes: IntArray
    means: FloatArray
    covariances: FloatArray
    frames: tuple[FlockFrame, ...]

    def __len__(self) -> int:
        return len(self.nodes)


def flock(kind: Kind, n: int, frames: int, seed: int, mixing: float = 0.35) -> Flock:
    """A flock of n cars over some frames.

    Who interacts follows from points that drift whatever the truth does, as edges are inputs to a filter.
    """
    rng = np.random.default_rng(seed)
    P = np.diag([0.25, 0.25, 1.0, 1.0])
    points, drift = rng.uniform(0, SPACING * np.sqrt(n), (n, 2)), SPEED * rng.normal(size=(n, 2))
    truth = np.concatenate([points, drift], axis=1)
    means = truth + rng.normal(size=(n, 4)) * np.sqrt(np.diag(P))
    order = rng.permutation(n) if kind == "components" else np.arange(n)  # groups are not told one after the other
    record = []
    for _ in range(frames):
        points = points + drift * DT
        target, source = _nearest(points) if kind == "connected" else _in_groups(order, rng)
        rate = rng.uniform(0.5, 1.5, len(target)) * -np.log(1 - mixing) / DT / NEIGHBOURS
        A = np.tile(np.diag([0.0, 0.0, 1.0, 1.0]), (len(target), 1, 1))
        edges = Edges("shared velocity", target, source, rate, -A, A, np.zeros((len(target), 4)))
        transition = discretise(SceneGraph.of(np.arange(n), CAR, [edges]), DT)
        truth = sample_step(transition, truth, rng)
        seen = np.flatnonzero(rng.random(n) >= MISSED)
        z = truth[seen, :2] + NOISE * rng.normal(size=(len(seen), 2))
        record.append(FlockFrame(transition, Measurements(seen, z, np.eye(2, 4), NOISE**2 * np.eye(2)), truth))
    return Flock(kind, np.arange(n), means, np.tile(P, (n, 1, 1)), tuple(record))


def sample_step(transition: Transition, states: FloatArray, rng: np.random.Generator) -> FloatArray:
    """States (n, d) at the end of an interval, with sampled process noise, in the order of the transition's nodes."""
    moved: FloatArray = (transition.F_matrix @ states.ravel() + transition.b).reshape(states.shape)
    for blocks in transition.Q:
        noise = rng.normal(size=(len(blocks.target), states.shape[1], 1))
        moved[blocks.target] += (np.linalg.cholesky(blocks.values) @ noise)[:, :, 0]
    return moved


def _nearest(points: FloatArray) -> tuple[IntArray, IntArray]:
    """Targets and sources: from the nearest others to each."""
    count = min(NEIGHBOURS, len(points) - 1)
    _, nearest = cKDTree(points).query(points, count + 1)
    return np.repeat(np.arange(len(points)), count), np.asarray(nearest)[:, 1:].ravel()


def _in_groups(order: IntArray, rng: np.random.Generator) -> tuple[IntArray, IntArray]:
    """Targets and sources: from most others of the group."""
    n = len(order)
    target = np.repeat(np.arange(n), GROUP - 1)
    first = target // GROUP * GROUP
    source = first + (target - first + np.tile(np.arange(1, GROUP), n)) % GROUP
    kept = (source < n) & (rng.random(len(target)) < 0.8)
    return order[target[kept]], order[source[kept]]

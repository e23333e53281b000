"""Random pose graphs for tests: drives round a loop, with measurements to earlier poses."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np

from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.pose_graph import PoseGraph, trusted


def moved(dim: int, tangents: FloatArray) -> FloatArray:
    """The transforms exp(tangent) of tangents (N, 3 or 6)."""
    exp = gtsam.Pose2.Expmap if dim == 2 else gtsam.Pose3.Expmap
    return np.stack([exp(tangent).matrix() for tangent in tangents])


def loop(dim: int, seed: int, rounds: int = 3, poses: int = 12, noise: float = 0.02) -> tuple[PoseGraph, FloatArray]:
    """A graph with a guess that is worth nothing, and its true poses (N, dim + 1, dim + 1)."""
    rng = np.random.default_rng(seed)
    k, n = 3 * (dim - 1), rounds * poses
    step = np.zeros(k)
    step[0 if dim == 2 else 3], step[2] = 1.0, 2 * np.pi / poses
    truth = [np.eye(dim + 1)]
    for tangent in step + 0.1 * rng.normal(size=(n - 1, k)):
        truth.append(truth[-1] @ moved(dim, tangent[None])[0])
    true = np.stack(truth)
    first = np.concatenate([np.arange(n - 1), np.arange(n - poses)])
    second = np.concatenate([np.arange(1, n), np.arange(poses, n)])
    flip = rng.random(len(first)) < 0.3  # measured from the later pose
    first, second = np.where(flip, second, first), np.where(flip, first, second)
    exact = np.linalg.inv(true[first]) @ true[second]
    measured = exact @ moved(dim, noise * rng.normal(size=(len(first), k)))
    information = np.broadcast_to(np.eye(k) / noise**2, (len(first), k, k))
    guess = moved(dim, 2.0 * rng.normal(size=(n, k)))
    guess[0] = true[0]
    return PoseGraph(np.arange(n) * 10, guess, first, second, measured, information), true


REACH = 10.0  # m, largest coordinate of a false measurement


def with_false_loops(graph: PoseGraph, share: float, seed: int) -> PoseGraph:
    """Append false loops, `share` times as many as the graph has loops, each with the information of one of these.

    Both poses, the position within 10 m by axis, and the rotation are uniformly distributed.
    """
    loops, n, rng = np.flatnonzero(~trusted(graph)), len(graph), np.random.default_rng(seed)
    count = round(share * len(loops))
    first = rng.integers(0, n, count)
    second = (first + rng.integers(2, n - 1, count)) % n  # neither the same nor a neighbour
    measured = np.array([_anywhere(rng, graph.dim) for _ in range(count)]).reshape(-1, graph.dim + 1, graph.dim + 1)
    return replace(
        graph,
        first=np.concatenate([graph.first, np.minimum(first, second)]),
        second=np.concatenate([graph.second, np.maximum(first, second)]),
        first_T_second=np.concatenate([graph.first_T_second, measured]),
        information=np.concatenate([graph.information, graph.information[rng.choice(loops, count)]]),
    )


def _anywhere(rng: np.random.Generator, d: int) -> FloatArray:
    place = rng.uniform(-REACH, REACH, d)
    if d == 2:
        return np.asarray(gtsam.Pose2(rng.uniform(-np.pi, np.pi), place).matrix())
    w, x, y, z = rng.normal(size=4)
    quaternion = np.array([w, x, y, z]) / np.linalg.norm([w, x, y, z])
    return np.asarray(gtsam.Pose3(gtsam.Rot3.Quaternion(*quaternion), place).matrix())

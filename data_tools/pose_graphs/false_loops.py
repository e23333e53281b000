"""False loop closures for pose graphs: random measurements between random poses."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.pose_graph import PoseGraph, trusted

_LEAST = 4  # poses, of which two are no neighbours, whichever is first
_REACH = 10.0  # m, largest coordinate of a false measurement


def with_false_loops(graph: PoseGraph, share: float, seed: int) -> PoseGraph:
    """Append false loops, `share` times as many as the graph has loops, each with the information of one of these.

    Both poses, the position within 10 m by axis, and the rotation are uniformly distributed. Raises `InputError`.
    """
    loops = np.flatnonzero(~trusted(graph))
    if not graph.poses_alone:
        raise InputError("expected a graph of poses alone, without landmarks and priors")
    if not len(loops) or len(graph) < _LEAST:
        raise InputError(f"expected {_LEAST} poses and a loop or more, got {len(graph)} and {len(loops)}")
    if not 0 <= share < np.inf:
        raise InputError(f"share: expected a number >= 0, got {share:g}")
    rng = np.random.default_rng(seed)
    count, n = round(share * len(loops)), len(graph)
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
    place = rng.uniform(-_REACH, _REACH, d)
    if d == 2:
        return np.asarray(gtsam.Pose2(rng.uniform(-np.pi, np.pi), place).matrix())
    w, x, y, z = rng.normal(size=4)
    return np.asarray(
        gtsam.Pose3(gtsam.Rot3.Quaternion(*(np.array([w, x, y, z]) / np.linalg.norm([w, x, y, z]))), place).matrix()
    )

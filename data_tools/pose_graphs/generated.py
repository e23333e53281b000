"""Generated pose graphs of known truth: a drive through a city of square blocks, and a path wound round a torus.

    city    in the plane: steps of 1 m, at every crossing (each `block` steps) straight on, left or right at random;
            measurements to one earlier pose within 1.5 m of each pose, where there is one
    torus   in space: K windings round the tube while going once round the hole, headings along the path; measurements
            to the neighbour on the winding before

The noise is Gaussian in the tangent of the measured pose, its information written with each measurement. The guess is
dead reckoning along the path. After the synthetic sets "city10000" and "torus3D" that pose-graph papers use (Kaess et
al., iSAM2, IJRR 2012; Rosen et al., SE-Sync, IJRR 2019).
"""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.planar_poses import transforms
from saga_fg.slam.pose_graph import PoseGraph

_NEAR = 1.5  # m, between poses of a city that see the same place
_APART = 10  # poses, at least, between the two of a loop closure


def city(poses: int, seed: int, block: int = 5, noise: float = 0.05) -> tuple[PoseGraph, FloatArray]:
    """A graph of a city, and its true poses (N, 3, 3); noise: m and, times 0.2, rad. Raises `InputError`."""
    _check(poses, noise)
    rng = np.random.default_rng(seed)
    turns = np.zeros(poses - 1)
    crossings = np.arange(block - 1, poses - 1, block)
    turns[crossings] = rng.choice([-np.pi / 2, 0.0, np.pi / 2], len(crossings))
    heading = np.concatenate([[0.0], np.cumsum(turns)])
    steps = np.stack([np.cos(heading[:-1]), np.sin(heading[:-1])], axis=1)
    place = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    true = transforms(np.column_stack([place, heading]))
    sigma = noise * np.array([1.0, 1.0, 0.2])
    return _measured(true, _revisits(place, rng), sigma, rng, gtsam.Pose2.Expmap), true


def torus(poses: int, seed: int, windings: int = 20, noise: float = 0.05) -> tuple[PoseGraph, FloatArray]:
    """A graph of a torus, and its true poses (N, 4, 4); noise: m and rad. Raises `InputError`."""
    _check(poses, noise)
    per_winding = poses // windings
    if windings < 2:
        raise InputError(f"windings: expected at least 2, got {windings}")
    if per_winding < 4:
        raise InputError(f"poses: expected at least {4 * windings}, 4 for each of {windings} windings, got {poses}")
    rng = np.random.default_rng(seed)
    round_tube = 2 * np.pi * np.arange(poses + 1) / per_winding
    round_hole = round_tube / windings
    radius = per_winding / (2 * np.pi)  # steps of about 1 m
    reach = 3 * radius + radius * np.cos(round_tube)
    place = np.stack([reach * np.cos(round_hole), reach * np.sin(round_hole), radius * np.sin(round_tube)], axis=1)
    ahead = np.diff(place, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    middle = 3 * radius * np.stack([np.cos(round_hole), np.sin(round_hole), 0 * round_hole], axis=1)[:-1]
    side = np.cross(place[:-1] - middle, ahead)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    true = np.tile(np.eye(4), (poses, 1, 1))
    true[:, :3, :3] = np.stack([ahead, side, np.cross(ahead, side)], axis=2)
    true[:, :3, 3] = place[:-1]
    later = np.arange(per_winding, poses)
    closures = np.stack([later - per_winding, later], axis=1)
    return _measured(true, closures, np.full(6, noise), rng, gtsam.Pose3.Expmap), true


def _revisits(place: FloatArray, rng: np.random.Generator) -> IntArray:
    """Pairs (earlier, later) of poses near to each other: for each later one an earlier one at random."""
    from scipy.spatial import cKDTree

    pairs = cKDTree(place).query_pairs(_NEAR, output_type="ndarray")
    pairs = pairs[pairs[:, 1] - pairs[:, 0] > _APART]
    shuffled = pairs[rng.permutation(len(pairs))]
    _, first = np.unique(shuffled[:, 1], return_index=True)
    return np.asarray(shuffled[first], dtype=np.int64)


def _measured(
    true: FloatArray,
    closures: IntArray,
    sigma: FloatArray,
    rng: np.random.Generator,
    exp: Callable[[FloatArray], gtsam.Pose2 | gtsam.Pose3],
) -> PoseGraph:
    n, k = len(true), len(sigma)
    steps = np.stack([np.arange(n - 1), np.arange(1, n)], axis=1)
    first, second = np.concatenate([steps, closures]).T
    tangents = sigma * rng.normal(size=(len(first), k))
    noise = np.stack([exp(tangent).matrix() for tangent in tangents])
    between = np.linalg.inv(true[first]) @ true[second] @ noise
    guess = [true[0]]
    for step in between[: n - 1]:
        guess.append(guess[-1] @ step)
    information = np.broadcast_to(np.diag(1 / sigma**2), (len(first), k, k))
    return PoseGraph(np.arange(n), np.stack(guess), first, second, between, information)


def _check(poses: int, noise: float) -> None:
    if poses < 2:
        raise InputError(f"poses: expected at least 2, got {poses}")
    if not 0 < noise < np.inf:
        raise InputError(f"noise: expected a number > 0, got {noise:g}")

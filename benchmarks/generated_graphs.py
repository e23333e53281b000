"""Pose graphs of known truth, of any size: drives through a city, and a path wound round a torus.

    city    in the plane: steps of 1 m, at every crossing (each 5 steps) straight on, left or right at random;
            measurements to one earlier pose within 1.5 m of each pose, where there is one
    torus   in space: windings round the tube while going once round the hole, headings along the path; measurements
            to the neighbour on the winding before

The noise is Gaussian in the tangent of the measured pose, its information written with each measurement. The guess is
dead reckoning along the path. After the synthetic sets "city10000" and "torus3D" that pose-graph papers use (Kaess et
al., iSAM2, IJRR 2012; Rosen et al., SE-Sync, IJRR 2019).
"""

from __future__ import annotations

import gtsam
import numpy as np
from scipy.spatial import cKDTree

from saga_fg.numerics import FloatArray, IntArray, transforms
from saga_fg.slam.pose_graph import PoseGraph

_NEAR, _BLOCK = 1.5, 5  # m, between poses of a city that see the same place; steps between crossings
_APART = 10  # poses, at least, between the two of a loop closure
Generated = tuple[PoseGraph, FloatArray]
"""A graph, and its true poses (N, d + 1, d + 1)."""


def city(poses: int, seed: int, noise: float = 0.05) -> Generated:
    """A graph of a city; noise: m, and a fifth of it in rad."""
    rng = np.random.default_rng(seed)
    turns = np.zeros(poses - 1)
    crossings = np.arange(_BLOCK - 1, poses - 1, _BLOCK)
    turns[crossings] = rng.choice([-np.pi / 2, 0.0, np.pi / 2], len(crossings))
    heading = np.concatenate([[0.0], np.cumsum(turns)])
    steps = np.stack([np.cos(heading[:-1]), np.sin(heading[:-1])], axis=1)
    place = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    pairs = cKDTree(place).query_pairs(_NEAR, output_type="ndarray")
    shuffled = rng.permutation(pairs[pairs[:, 1] - pairs[:, 0] > _APART])
    _, first = np.unique(shuffled[:, 1], return_index=True)  # for each later pose an earlier one at random
    return _measured(transforms(np.column_stack([place, heading])), shuffled[first], noise, rng)


def torus(poses: int, seed: int, windings: int = 20, noise: float = 0.05) -> Generated:
    """A graph of a torus, of four poses a winding at least; noise: m and rad. x is along the path, z nearly outward."""
    rng, per_winding = np.random.default_rng(seed), poses // windings
    round_tube = 2 * np.pi * np.arange(poses + 1, dtype=np.float64) / per_winding
    round_hole, radius = round_tube / windings, per_winding / (2 * np.pi)  # steps of about 1 m
    reach = 3 * radius + radius * np.cos(round_tube)
    place = np.stack([reach * np.cos(round_hole), reach * np.sin(round_hole), radius * np.sin(round_tube)], axis=1)
    middle = 3 * radius * np.stack([np.cos(round_hole), np.sin(round_hole), 0 * round_hole], axis=1)
    ahead = np.diff(place, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    side = np.cross((place - middle)[:-1], ahead)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    true = np.tile(np.eye(4), (poses, 1, 1))
    true[:, :3, :3] = np.stack([ahead, side, np.cross(ahead, side)], axis=2)
    true[:, :3, 3] = place[:-1]
    later = np.arange(per_winding, poses)
    return _measured(true, np.stack([later - per_winding, later], axis=1), noise, rng)


def _measured(true: FloatArray, closures: IntArray, noise: float, rng: np.random.Generator) -> Generated:
    """The graph of true poses, measured from each to the next and between the pairs (n, 2) `closures`."""
    n, planar = len(true), true.shape[1] == 3
    sigma = noise * (np.array([1.0, 1.0, 0.2]) if planar else np.ones(6))
    exp = gtsam.Pose2.Expmap if planar else gtsam.Pose3.Expmap
    steps = np.stack([np.arange(n - 1), np.arange(1, n)], axis=1)
    first, second = np.concatenate([steps, closures.astype(np.int64)]).T
    tangents = sigma * rng.normal(size=(len(first), len(sigma)))
    between = np.linalg.inv(true[first]) @ true[second] @ np.stack([exp(tangent).matrix() for tangent in tangents])
    guess = [true[0]]
    for step in between[: n - 1]:
        guess.append(guess[-1] @ step)
    information = np.broadcast_to(np.diag(1 / sigma**2), (len(first), len(sigma), len(sigma)))
    return PoseGraph(np.arange(n), np.stack(guess), first, second, between, information), true

"""Pose graphs of known truth, of any size, and false loops for them.

Generated pose graphs of known truth: drives through a city and over grids, paths wound round a torus and a sphere.

    city    in the plane: steps of 1 m, at every crossing (each `block` steps) straight on, left or right at random;
            measurements to one earlier pose within 1.5 m of each pose, where there is one
    torus   in space: K windings round the tube while going once round the hole, headings along the path; measurements
            to the neighbour on the winding before
    sphere  in space: a spiral from pole to pole, headings along the path; measurements to the neighbour on the turn
            before
    grid    in the plane: steps of 1 m, row by row to and fro over a square; measurements between all neighbours
    cube    the same in space, layer by layer

The noise is Gaussian in the tangent of the measured pose, its information written with each measurement. The guess is
dead reckoning along the path. After the synthetic sets "city10000", "torus3D", "sphere" and "grid3D" that pose-graph
papers use (Kaess et al., iSAM2, IJRR 2012; Rosen et al., SE-Sync, IJRR 2019).
"""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.geometry import transforms
from saga_fg.slam.pose_graph import PoseGraph

_NEAR = 1.5  # m, between poses of a city that see the same place
_APART = 10  # poses, at least, between the two of a loop closure


def city(poses: int, seed: int, block: int = 5, noise: float = 0.05) -> tuple[PoseGraph, FloatArray]:
    """A graph of a city, and its true poses (N, 3, 3); noise as of a city. Raises `InputError`."""
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
    middle = 3 * radius * np.stack([np.cos(round_hole), np.sin(round_hole), 0 * round_hole], axis=1)
    true = _along(place, place - middle)
    closures = _neighbours_before(poses, per_winding)
    return _measured(true, closures, np.full(6, noise), rng, gtsam.Pose3.Expmap), true


def sphere(poses: int, seed: int, turns: int | None = None, noise: float = 0.05) -> tuple[PoseGraph, FloatArray]:
    """A graph of a sphere, and its true poses (N, 4, 4); turns: of the spiral, by default as many as poses in each.

    noise: m and rad. Raises `InputError`.
    """
    _check(poses, noise)
    turns = max(2, round(np.sqrt(poses))) if turns is None else turns
    if turns < 2:
        raise InputError(f"turns: expected at least 2, got {turns}")
    per_turn = poses // turns
    if per_turn < 4:
        raise InputError(f"poses: expected at least {4 * turns}, 4 for each of {turns} turns, got {poses}")
    rng = np.random.default_rng(seed)
    row = np.arange(poses + 1)
    azimuth, from_pole = 2 * np.pi * row / per_turn, np.pi * (row + 0.5) / (poses + 1)
    outward = np.stack(
        [np.sin(from_pole) * np.cos(azimuth), np.sin(from_pole) * np.sin(azimuth), -np.cos(from_pole)], axis=1
    )
    true = _along(per_turn / (2 * np.pi) * outward, outward)  # steps of about 1 m at the equator
    return _measured(true, _neighbours_before(poses, per_turn), np.full(6, noise), rng, gtsam.Pose3.Expmap), true


def grid(poses: int, seed: int, noise: float = 0.05) -> tuple[PoseGraph, FloatArray]:
    """A graph of a grid in the plane, and its true poses (N, 3, 3); noise as of a city. Raises `InputError`."""
    _check(poses, noise)
    place = _to_and_fro(poses, 2)
    true = transforms(np.column_stack([place[:-1], _headings(place)]))
    sigma = noise * np.array([1.0, 1.0, 0.2])
    return _measured(true, _all_neighbours(place[:-1]), sigma, np.random.default_rng(seed), gtsam.Pose2.Expmap), true


def cube(poses: int, seed: int, noise: float = 0.05) -> tuple[PoseGraph, FloatArray]:
    """A graph of a grid in space, and its true poses (N, 4, 4); noise: m and rad. Raises `InputError`."""
    _check(poses, noise)
    place, rng = _to_and_fro(poses, 3), np.random.default_rng(seed)
    true = np.tile(np.eye(4), (poses, 1, 1))
    level = transforms(np.column_stack([place[:-1, :2], _headings(place)]))
    true[:, :2, :2], true[:, :3, 3] = level[:, :2, :2], place[:-1]
    return _measured(true, _all_neighbours(place[:-1]), np.full(6, noise), rng, gtsam.Pose3.Expmap), true


def _along(place: FloatArray, outward: FloatArray) -> FloatArray:
    """Poses (N, 4, 4) at the first N of N + 1 places, x along the path and z nearly in a direction (N + 1, 3)."""
    ahead = np.diff(place, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    side = np.cross(outward[:-1], ahead)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    true = np.tile(np.eye(4), (len(ahead), 1, 1))
    true[:, :3, :3] = np.stack([ahead, side, np.cross(ahead, side)], axis=2)
    true[:, :3, 3] = place[:-1]
    return true


def _neighbours_before(poses: int, per_turn: int) -> IntArray:
    later = np.arange(per_turn, poses)
    return np.stack([later - per_turn, later], axis=1)


def _to_and_fro(poses: int, d: int) -> FloatArray:
    """Places (N + 1, d) of a path through the cells of a square or cube, each next to the one before."""
    side = int(np.ceil((poses + 1) ** (1 / d) - 1e-9))
    cells = np.indices((side,) * d).reshape(d, -1)  # the last axis runs fastest
    for axis in range(1, d):
        back = cells[:axis].sum(axis=0) % 2 == 1
        cells[axis] = np.where(back, side - 1 - cells[axis], cells[axis])
    return np.asarray(cells[::-1, : poses + 1].T, dtype=np.float64)


def _headings(place: FloatArray) -> FloatArray:
    """Headings (N,) of the steps between places; upward steps keep the one before."""
    step = np.diff(place, axis=0)
    level = np.abs(step[:, :2]).max(axis=1) > 0
    last = np.maximum.accumulate(np.where(level, np.arange(len(step)), 0))
    return np.arctan2(step[:, 1], step[:, 0])[last]


def _all_neighbours(place: FloatArray) -> IntArray:
    """Pairs (earlier, later) of cells of a grid that are next to each other, but not successive."""
    from scipy.spatial import cKDTree

    pairs = np.sort(cKDTree(place).query_pairs(1.1, output_type="ndarray"), axis=1)
    pairs = pairs[pairs[:, 1] - pairs[:, 0] > 1]
    return np.asarray(pairs[np.lexsort(pairs.T)], dtype=np.int64)


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

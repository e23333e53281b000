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
from scipy.spatial import cKDTree

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.geometry import transforms
from saga_fg.slam.pose_graph import PoseGraph

_NEAR = 1.5  # m, between poses of a city that see the same place
_APART = 10  # poses, at least, between the two of a loop closure
Generated = tuple[PoseGraph, FloatArray]
"""A graph, and its true poses (N, d + 1, d + 1)."""


def city(poses: int, seed: int, block: int = 5, noise: float = 0.05) -> Generated:
    """A graph of a city; noise: m, and a fifth of it in rad. Raises `InputError`."""
    rng = _checked_rng(poses, seed, noise)
    turns = np.zeros(poses - 1)
    crossings = np.arange(block - 1, poses - 1, block)
    turns[crossings] = rng.choice([-np.pi / 2, 0.0, np.pi / 2], len(crossings))
    heading = np.concatenate([[0.0], np.cumsum(turns)])
    steps = np.stack([np.cos(heading[:-1]), np.sin(heading[:-1])], axis=1)
    place = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    pairs = cKDTree(place).query_pairs(_NEAR, output_type="ndarray")
    shuffled = rng.permutation(pairs[pairs[:, 1] - pairs[:, 0] > _APART])
    _, first = np.unique(shuffled[:, 1], return_index=True)  # for each later pose an earlier one at random
    return _measured(transforms(np.column_stack([place, heading])), shuffled[first], noise, rng)


def torus(poses: int, seed: int, windings: int = 20, noise: float = 0.05) -> Generated:
    """A graph of a torus; noise: m and rad. Raises `InputError`."""

    def shape(row: FloatArray, per_winding: int) -> tuple[FloatArray, FloatArray]:
        round_tube = 2 * np.pi * row / per_winding
        round_hole, radius = round_tube / windings, per_winding / (2 * np.pi)  # steps of about 1 m
        reach = 3 * radius + radius * np.cos(round_tube)
        place = np.stack([reach * np.cos(round_hole), reach * np.sin(round_hole), radius * np.sin(round_tube)], axis=1)
        middle = 3 * radius * np.stack([np.cos(round_hole), np.sin(round_hole), 0 * round_hole], axis=1)
        return place, place - middle

    return _wound("windings", windings, poses, seed, noise, shape)


def sphere(poses: int, seed: int, turns: int | None = None, noise: float = 0.05) -> Generated:
    """A graph of a sphere; turns: of the spiral, by default as many as poses in each.

    noise: m and rad. Raises `InputError`.
    """

    def shape(row: FloatArray, per_turn: int) -> tuple[FloatArray, FloatArray]:
        azimuth, from_pole = 2 * np.pi * row / per_turn, np.pi * (row + 0.5) / (poses + 1)
        outward = np.stack(
            [np.sin(from_pole) * np.cos(azimuth), np.sin(from_pole) * np.sin(azimuth), -np.cos(from_pole)], axis=1
        )
        return per_turn / (2 * np.pi) * outward, outward  # steps of about 1 m at the equator

    return _wound("turns", max(2, round(np.sqrt(max(poses, 0)))) if turns is None else turns, poses, seed, noise, shape)


def grid(poses: int, seed: int, noise: float = 0.05) -> Generated:
    """A graph of a grid in the plane; noise as of a city. Raises `InputError`."""
    return _lattice(poses, seed, noise, 2)


def cube(poses: int, seed: int, noise: float = 0.05) -> Generated:
    """A graph of a grid in space; noise: m and rad. Raises `InputError`."""
    return _lattice(poses, seed, noise, 3)


def _checked_rng(poses: int, seed: int, noise: float) -> np.random.Generator:
    if poses < 2:
        raise InputError(f"poses: expected at least 2, got {poses}")
    if not 0 < noise < np.inf:
        raise InputError(f"noise: expected a number > 0, got {noise:g}")
    return np.random.default_rng(seed)


def _wound(
    name: str,
    turns: int,
    poses: int,
    seed: int,
    noise: float,
    shape: Callable[[FloatArray, int], tuple[FloatArray, FloatArray]],
) -> Generated:
    """A path in turns, measured to the neighbour on the turn before; shape: places (N + 1, 3) and directions outward.

    Poses are at the first N places, x along the path and z nearly outward.
    """
    rng = _checked_rng(poses, seed, noise)
    if turns < 2:
        raise InputError(f"{name}: expected at least 2, got {turns}")
    if (per_turn := poses // turns) < 4:
        raise InputError(f"poses: expected at least {4 * turns}, 4 for each of {turns} {name}, got {poses}")
    place, outward = shape(np.arange(poses + 1, dtype=np.float64), per_turn)
    ahead = np.diff(place, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    side = np.cross(outward[:-1], ahead)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    true = np.tile(np.eye(4), (poses, 1, 1))
    true[:, :3, :3] = np.stack([ahead, side, np.cross(ahead, side)], axis=2)
    true[:, :3, 3] = place[:-1]
    later = np.arange(per_turn, poses)
    return _measured(true, np.stack([later - per_turn, later], axis=1), noise, rng)


def _lattice(poses: int, seed: int, noise: float, d: int) -> Generated:
    """To and fro through a square or a cube, measured between all neighbours."""
    rng, place = _checked_rng(poses, seed, noise), _to_and_fro(poses, d)
    step = np.diff(place, axis=0)
    level = np.abs(step[:, :2]).max(axis=1) > 0  # upward steps keep the heading of the one before
    last = np.maximum.accumulate(np.where(level, np.arange(len(step)), 0))
    planar = transforms(np.column_stack([place[:-1, :2], np.arctan2(step[:, 1], step[:, 0])[last]]))
    true = np.tile(np.eye(d + 1), (poses, 1, 1))
    true[:, :2, :2], true[:, :d, d] = planar[:, :2, :2], place[:-1]
    pairs = np.sort(cKDTree(place[:-1]).query_pairs(1.1, output_type="ndarray"), axis=1)
    pairs = pairs[pairs[:, 1] - pairs[:, 0] > 1]
    return _measured(true, pairs[np.lexsort(pairs.T)], noise, rng)


def _to_and_fro(poses: int, d: int) -> FloatArray:
    """Places (N + 1, d) of a path through the cells of a square or cube, each next to the one before."""
    side = int(np.ceil((poses + 1) ** (1 / d) - 1e-9))
    cells = np.indices((side,) * d).reshape(d, -1)  # the last axis runs fastest
    for axis in range(1, d):
        back = cells[:axis].sum(axis=0) % 2 == 1
        cells[axis] = np.where(back, side - 1 - cells[axis], cells[axis])
    return np.asarray(cells[::-1, : poses + 1].T, dtype=np.float64)


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

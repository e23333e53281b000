"""Poses in the plane, as x, y, heading and as matrices, m and rad."""

from __future__ import annotations

import numpy as np

from saga_fg.numerics.arrays import FloatArray


def transforms(x: FloatArray) -> FloatArray:
    """Poses (n, 3): x, y, heading as (n, 3, 3)."""
    c, s = np.cos(x[:, 2]), np.sin(x[:, 2])
    T = np.tile(np.eye(3), (len(x), 1, 1))
    T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = c, -s, s, c
    T[:, :2, 2] = x[:, :2]
    return T


def transform(x: FloatArray) -> FloatArray:
    """A pose (3,) as (3, 3)."""
    return np.asarray(transforms(x[None])[0])


def vectors(T: FloatArray) -> FloatArray:
    """Poses (n, 3, 3) as x, y, heading (n, 3)."""
    return np.stack([T[:, 0, 2], T[:, 1, 2], np.arctan2(T[:, 1, 0], T[:, 0, 0])], axis=1)


def vector(T: FloatArray) -> FloatArray:
    """A pose (3, 3) as x, y, heading."""
    return np.asarray(vectors(T[None])[0])


def heading(T: FloatArray) -> float:
    """The heading of a pose (3, 3)."""
    return float(np.arctan2(T[1, 0], T[0, 0]))


def moved(points: FloatArray, T: FloatArray) -> FloatArray:
    """Points (n, 2) by a pose (3, 3)."""
    return np.asarray(points @ T[:2, :2].T + T[:2, 2])

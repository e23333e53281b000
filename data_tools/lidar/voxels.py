"""Points on a cubic grid: voxel downsampling.

The voxel of a point p is floor(p / size), a triple of integers; packed into one integer of 3 x 21 bits, so that voxels
sort and compare as numbers. With voxels of 0.1 m that reaches 100 km in every direction.
"""

from __future__ import annotations

import numpy as np

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray

_BITS = 21
_HALF = 1 << (_BITS - 1)


def voxel_keys(points: FloatArray, size: float) -> IntArray:
    """The voxels (N,) of points (N, 3), m; `size` in m. Raises `InputError` for points off the grid."""
    if not size > 0:
        raise InputError(f"size: expected a voxel size > 0 m, got {size!r}")
    index = np.floor(points / size)
    if len(index) and np.abs(index).max() >= _HALF:
        raise InputError(f"points: expected coordinates within {_HALF * size:g} m for voxels of {size:g} m")
    cell = index.astype(np.int64) + _HALF
    return np.asarray((cell[:, 0] << 2 * _BITS) | (cell[:, 1] << _BITS) | cell[:, 2])


def voxel_downsample(points: FloatArray, size: float) -> IntArray:
    """Rows (M,) of `points` (N, 3), one for each voxel of `size` m: the first point in it, in ascending order.

    A point of the scan rather than the mean of several: means shrink edges and lie on no surface.
    """
    _, first = np.unique(voxel_keys(points, size), return_index=True)
    return np.sort(first)

"""Where variables were linearised, and how far they have moved since, in standard deviations."""

from __future__ import annotations

from collections.abc import Iterable, KeysView, Mapping

import gtsam
import numpy as np

from saga_fg.numerics.arrays import FloatArray


class Displacements:
    """Variables with delta_0 (d,), where their factors were linearised, and R (d, d), in rows without gaps.

    Rows are as wide as the largest variable; what a smaller one does not fill is zero.
    """

    def __init__(self) -> None:
        self._keys: list[int] = []
        self._row: dict[int, int] = {}
        self._dims: dict[int, int] = {}
        self._at, self._root = np.zeros((16, 0)), np.zeros((16, 0, 0))

    def add(self, dims: Mapping[int, int]) -> None:
        """New variables at their base."""
        first, (rows, width) = len(self._keys), self._at.shape
        more = 2 * len(dims) + rows if first + len(dims) > rows else 0
        wider = max([width, *dims.values()]) - width
        if more or wider:
            self._at = np.pad(self._at, ((0, more), (0, wider)))
            self._root = np.pad(self._root, ((0, more), (0, wider), (0, wider)))
        self._keys += dims
        self._row |= dict(zip(dims, range(first, len(self._keys)), strict=True))
        self._dims |= dims

    def remove(self, keys: Iterable[int]) -> None:
        """Forget variables; the last one takes the row of each."""
        for key in keys:
            row, last = self._row.pop(key), self._keys.pop()
            del self._dims[key]
            end = len(self._keys)
            if last != key:
                self._keys[row], self._row[last] = last, row
                self._at[row], self._root[row] = self._at[end], self._root[end]
            self._at[end], self._root[end] = 0.0, 0.0

    def dims(self, keys: Iterable[int]) -> dict[int, int]:
        """Dimensions of variables, by key in their order."""
        return {key: self._dims[key] for key in keys}

    @property
    def keys(self) -> KeysView[int]:
        """All variables."""
        return self._dims.keys()

    def set_root(self, key: int, R: FloatArray) -> None:
        """Set R of a variable."""
        self._root[self._row[key], : len(R), : len(R)] = R

    def moved(self, delta: gtsam.VectorValues, threshold: float) -> list[int]:
        """Variables that are farther off than the threshold; their linearisation point is reset."""
        if not self._keys:
            return []
        n, now = len(self._keys), np.zeros_like(self._at[: len(self._keys)])
        dims = np.array([self._dims[key] for key in self._keys])
        now[np.arange(now.shape[1]) < dims[:, None]] = delta.vector(self._keys)
        way = (self._root[:n] @ (now - self._at[:n])[:, :, None])[:, :, 0]
        rows = np.flatnonzero(np.linalg.norm(way, axis=1) > threshold)
        self._at[rows] = now[rows]
        return [self._keys[row] for row in rows.tolist()]

"""Which variables have moved so far that factors on them have to be linearised anew.

    || R (delta - delta_0) ||  >  threshold,      R^T R = P^-1

counts the way from where a variable's factors were linearised, delta_0, in its own standard deviations (Mahalanobis
distance in its marginal covariance P). Fluid relinearisation after Kaess et al., "iSAM2", IJRR 31 (2012), section 4.1,
whose threshold is in the units of each variable. R is asked for anew whenever new factors speak of a variable.
"""

from __future__ import annotations

from collections.abc import Iterable

import gtsam
import numpy as np

from saga_fg.numerics.arrays import FloatArray


class LinearisationPoints:
    """For every variable delta_0 (d,) and R (d, d), by dimension."""

    def __init__(self) -> None:
        self._tables: dict[int, _Table] = {}
        self._dims: dict[int, int] = {}

    def add(self, dims: dict[int, int]) -> None:
        """New variables at their base."""
        for key, dim in dims.items():
            self._dims[key] = dim
            self._tables.setdefault(dim, _Table(dim)).add(key)

    def remove(self, keys: Iterable[int]) -> None:
        """Forget variables."""
        for key in keys:
            self._tables[self._dims.pop(key)].remove(key)

    def __contains__(self, key: int) -> bool:
        return key in self._dims

    @property
    def keys(self) -> Iterable[int]:
        """All variables."""
        return self._dims.keys()

    def set_root(self, key: int, R: FloatArray) -> None:
        """Set R of a variable."""
        table = self._tables[self._dims[key]]
        table.root[table.row[key]] = R

    def moved(self, delta: gtsam.VectorValues, threshold: float) -> list[int]:
        """The variables that are farther off than the threshold; from now on they count from here."""
        return [key for table in self._tables.values() for key in table.moved(delta, threshold)]


class _Table:
    """Variables of one dimension in rows without gaps."""

    def __init__(self, dim: int) -> None:
        self.keys: list[int] = []
        self.row: dict[int, int] = {}
        self.at = np.zeros((16, dim))
        self.root = np.zeros((16, dim, dim))

    def add(self, key: int) -> None:
        n = len(self.keys)
        if n == len(self.at):
            self.at, self.root = (np.concatenate([a, np.zeros_like(a)]) for a in (self.at, self.root))
        self.row[key] = n
        self.keys.append(key)
        self.at[n], self.root[n] = 0.0, 0.0

    def remove(self, key: int) -> None:
        n, last = self.row.pop(key), self.keys.pop()
        if last != key:
            self.keys[n], self.row[last] = last, n
            self.at[n], self.root[n] = self.at[len(self.keys)], self.root[len(self.keys)]

    def moved(self, delta: gtsam.VectorValues, threshold: float) -> list[int]:
        n = len(self.keys)
        if n == 0:
            return []
        now = np.asarray(delta.vector(self.keys)).reshape(n, -1)
        way = (self.root[:n] @ (now - self.at[:n])[:, :, None])[:, :, 0]
        rows = np.flatnonzero(np.linalg.norm(way, axis=1) > threshold)
        self.at[rows] = now[rows]
        return [self.keys[row] for row in rows.tolist()]

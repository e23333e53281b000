"""Layout of a joint state vector: the place of each node's state."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError, UnknownNodeError
from saga_fg.numerics.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    checked,
    checked_covariances,
    checked_ids,
    checked_rows,
    unchecked,
)


@dataclass(frozen=True, eq=False)
class StateLayout:
    """Ids of the nodes (n,) in order, the sizes of their states (n,), and their places in the joint state (n + 1,)."""

    nodes: IntArray = ()  # type: ignore[assignment]  # arrays from construction on
    dims: IntArray = ()  # type: ignore[assignment]
    offsets: IntArray = field(init=False)

    def __post_init__(self) -> None:
        nodes, dims = checked_ids("nodes", self.nodes), checked_rows("dims", self.dims, len(self.nodes))
        for name, array in (("nodes", nodes), ("dims", dims), ("offsets", np.concatenate([[0], np.cumsum(dims)]))):
            object.__setattr__(self, name, array.astype(np.int64, copy=False))

    @cached_property
    def _order(self) -> IntArray | None:
        """(n,) rows by ascending id; None where they are in that order already."""
        ascending = (self.nodes[1:] > self.nodes[:-1]).all()
        return None if ascending else np.argsort(self.nodes)

    @cached_property
    def _sorted(self) -> IntArray:
        """(n,) ids, ascending."""
        return self.nodes if self._order is None else self.nodes[self._order]

    def _places(self, ids: IntArray) -> tuple[IntArray, BoolArray]:
        """Places (k,) of ids (k,) in the ascending order, and which of them (k,) are in the layout."""
        if len(self) == 0 or len(ids) == 0:
            return np.zeros(len(ids), dtype=np.int64), np.zeros(len(ids), dtype=bool)
        nodes = self._sorted
        at = np.minimum(nodes.searchsorted(ids.astype(np.int64, copy=False)), len(nodes) - 1)
        return at, nodes[at] == ids

    def __len__(self) -> int:
        return len(self.nodes)

    @property
    def size(self) -> int:
        """Size D of the joint state."""
        return int(self.offsets[-1])

    def rows(self, nodes: ArrayLike) -> IntArray:
        """Rows of some node ids; raises `UnknownNodeError` naming the first that is not here."""
        ids = np.asarray(nodes)
        if ids.ndim != 1 or (ids.size and ids.dtype.kind not in "iu"):
            raise InputError(f"nodes: expected a list of integer ids, got {nodes!r}")
        if len(ids) == len(self.nodes) and not np.count_nonzero(ids != self.nodes):
            return np.arange(len(ids))
        at, known = self._places(ids)
        if not known.all():
            raise UnknownNodeError(f"node {ids[int(np.argmin(known))]} is not in the estimator")
        return at if self._order is None else self._order[at]

    def spans(self, rows: IntArray) -> IntArray:
        """(k, d) places in the joint state of rows whose states have equal size d; `InputError` if they have not."""
        dims = self.dims[rows]
        if len(rows) and (dims != dims[0]).any():
            raise InputError(f"nodes: expected states of equal size, got sizes {sorted(set(dims.tolist()))}")
        return np.asarray(self.offsets[rows][:, None] + np.arange(dims[0] if len(rows) else 0))

    def places(self, rows: IntArray) -> IntArray:
        """Places in the joint state of rows of any sizes, stacked."""
        if len(rows) == 0:
            return np.empty(0, dtype=np.int64)
        dims = self.dims[rows]
        ends = np.cumsum(dims)
        return np.asarray(np.repeat(self.offsets[rows] - (ends - dims), dims) + np.arange(ends[-1]))

    def extended(self, nodes: ArrayLike, dim: int) -> StateLayout:
        """Add nodes of size `dim` at the end; raises `InputError` for an id that is here already."""
        ids = checked_ids("nodes", nodes)
        _, known = self._places(ids)
        if known.any():
            raise InputError(f"node {ids[int(np.argmax(known))]} is in the estimator already")
        dims = np.concatenate([self.dims, np.full(len(ids), dim)])
        further = self.offsets[-1] + dim * np.arange(1, len(ids) + 1)
        offsets = np.concatenate([self.offsets, further])
        return unchecked(StateLayout, nodes=np.concatenate([self.nodes, ids]), dims=dims, offsets=offsets)

    def without(self, rows: IntArray) -> StateLayout:
        keep = np.ones(len(self), dtype=bool)
        keep[rows] = False
        return self.select(keep)

    def select(self, rows: IntArray | BoolArray) -> StateLayout:
        """The nodes of some rows, or of a mask, in their order."""
        dims = self.dims[rows]
        offsets = np.zeros(len(dims) + 1, dtype=np.int64)
        np.cumsum(dims, out=offsets[1:])
        return unchecked(StateLayout, nodes=self.nodes[rows], dims=dims, offsets=offsets)


def checked_prior(nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Means (k, d) and symmetric positive definite covariances (k, d, d) of new nodes, or `InputError`."""
    k = len(checked_ids("nodes", nodes))
    mean = checked("means", means, (k, None))
    return mean, checked_covariances("covariances", covariances, k, mean.shape[1])

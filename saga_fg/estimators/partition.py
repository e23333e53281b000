"""The joint state vector: the place of each node's state, and the components it splits into.

Components of the joint state: sets of nodes that are correlated among themselves and with no others.

    P = blockdiag( P_1, ..., P_C )       one dense block a component

Interactions join components; between components every covariance is exactly zero and is neither stored nor computed.
Components of equal size are stacked, so that all of them take one batched operation.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError, UnknownNodeError
from saga_fg.kernels.components import component_tables, regrouped_blocks, united_labels
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


_FEW = 4  # components of a size that are not worth a batched operation of their own
_PACK = 64  # states that such components together may have


class BlockPlaces(NamedTuple):
    """Index of the blocks of a block-diagonal matrix, which lie one after the other in one array, for kernels.

    start, size (n,) of the block of each node's component; offset (n,) of the node's state in it; first (n,): where its
    component begins in `places` (D,), which are those of the states in the joint state. See
    `saga_fg.kernels.components`.
    """

    start: IntArray
    size: IntArray
    offset: IntArray
    first: IntArray
    places: IntArray


@dataclass(frozen=True, eq=False)
class Partition:
    """The components of a joint state.

    layout  the nodes and their places in the joint state
    label   (n,) component of every node, numbered from 0 without gaps
    """

    layout: StateLayout
    label: IntArray

    def __post_init__(self) -> None:
        n, label = len(self.layout), self.label
        if label.shape != (n,) or label.dtype != np.int64 or (n and not 0 <= label.min() <= label.max() < n):
            raise InputError(f"label: expected components (n,) of {n} nodes, whole numbers from 0")

    @staticmethod
    def apart(layout: StateLayout) -> Partition:
        """Every node a component of its own."""
        return Partition(layout, np.arange(len(layout)))

    @cached_property
    def count(self) -> int:
        """Number of components."""
        return int(self.label.max(initial=-1)) + 1

    @cached_property
    def groups(self) -> tuple[IntArray, ...]:
        """For each size s of components, (c, s): the places of their states in the joint state; nodes in order."""
        return self._tables[0]

    @property
    def group(self) -> IntArray:
        """(n,) number of the group of each node's component."""
        return self._tables[1]

    @property
    def row(self) -> IntArray:
        """(n,) row of each node's component within its group."""
        return self._tables[2]

    @property
    def offset(self) -> IntArray:
        """(n,) where each node's state begins within its component."""
        return self.block_places.offset

    @cached_property
    def _tables(self) -> tuple[tuple[IntArray, ...], IntArray, IntArray, BlockPlaces]:
        """Groups, group and row of each node, and what kernels need."""
        group, row, offset, start, size, first, sizes, counts, places = component_tables(self.label, self.layout.dims)
        groups, at = [], 0
        for s, c in zip(sizes.tolist(), counts.tolist(), strict=True):
            groups.append(places[at : at + c * s].reshape(c, s))
            at += c * s
        return tuple(groups), group, row, BlockPlaces(start, size, offset, first, places)

    @property
    def block_places(self) -> BlockPlaces:
        """Index of the blocks, for kernels."""
        return self._tables[3]

    def joined(self, target: IntArray, source: IntArray) -> Partition:
        """Join the components of node rows target[k] and source[k]; itself where they are one already."""
        a, b = self.label[target], self.label[source]
        across = a != b
        return self.joined_up_to(a[across], b[across], len(self.label)) if across.any() else self

    def joined_up_to(self, a: IntArray, b: IntArray, most: int) -> Partition:
        """Join the components of labels a[k] and b[k], pair by pair, to at most `most` nodes each."""
        nodes = np.bincount(self.label, minlength=self.count)
        return Partition(self.layout, united_labels(self.count, nodes, a, b, most)[self.label])

    @cached_property
    def packed(self) -> Partition:
        """Put small components of several nodes together whose sizes few others have.

        That spares a batched operation for each size. What moves alone stays alone, to the last digit.
        """
        nodes = np.bincount(self.label)
        size = np.bincount(self.label, weights=self.layout.dims).astype(np.int64)
        rare = ((nodes > 1) & (np.bincount(size)[size] < _FEW)).nonzero()[0]
        order = rare[np.argsort(size[rare], kind="stable")]
        chosen = order[np.cumsum(size[order]) <= _PACK]
        if len(chosen) < 2:
            return self
        number = np.arange(len(size))
        number[chosen] = chosen.min()
        return Partition(self.layout, _without_gaps(number[self.label]))

    def extended(self, layout: StateLayout) -> Partition:
        """Add the further nodes at the end of `layout`, each a component of its own."""
        return Partition(layout, np.concatenate([self.label, self.count + np.arange(len(layout) - len(self.layout))]))

    def restricted(self, layout: StateLayout, rows: IntArray) -> Partition:
        """Partition of the nodes at `rows` alone, which are those of `layout`."""
        return Partition(layout, _without_gaps(self.label[rows]))


def _without_gaps(label: IntArray) -> IntArray:
    """The labels (n,) >= 0 renumbered in their order, from 0 without gaps."""
    used = np.bincount(label) > 0
    return np.asarray((np.cumsum(used) - 1)[label])


BlockDiagonal = tuple[FloatArray, ...]  # (c, s, s) for each group of a partition


def zeros(partition: Partition) -> BlockDiagonal:
    """The blocks of the zero matrix."""
    return tuple(np.zeros((*places.shape, places.shape[1])) for places in partition.groups)


def flattened(blocks: BlockDiagonal) -> FloatArray:
    """All blocks one after the other, as kernels take them; without copying if they are parts of one array already."""
    if len(blocks) == 0:
        return np.empty(0)
    whole, size = blocks[0].base, sum(block.size for block in blocks)
    parts = all(block.base is whole for block in blocks)
    if parts and isinstance(whole, np.ndarray) and whole.ndim == 1 and whole.size == size:  # bytes after unpickling
        return whole
    return np.concatenate([block.ravel() for block in blocks])


def unflattened(flat: FloatArray, partition: Partition) -> BlockDiagonal:
    """The blocks (c, s, s) of each group as views of one array."""
    blocks, at = [], 0
    for places in partition.groups:
        c, s = places.shape
        blocks.append(flat[at : at + c * s * s].reshape(c, s, s))
        at += c * s * s
    return tuple(blocks)


def regrouped(blocks: BlockDiagonal, old: Partition, new: Partition, source: IntArray) -> BlockDiagonal:
    """Copy the blocks of a matrix over to another partition.

    source: for each node of `new` its row in `old`, -1 for none; a row may serve several nodes. Entries between nodes
    in different components of either partition are zero.
    """
    if len(new.label) == 0:
        return ()
    here, there, length = old.block_places, new.block_places, sum(p.size * p.shape[1] for p in new.groups)
    flat = regrouped_blocks(
        flat=flattened(blocks),
        label=old.label,
        start=here.start,
        size=here.size,
        offset=here.offset,
        dims=old.layout.dims,
        source=source,
        new_label=new.label,
        new_start=there.start,
        new_size=there.size,
        new_offset=there.offset,
        length=length,
    )
    return unflattened(flat, new)

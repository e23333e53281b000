"""The joint state vector: places of nodes, the components it splits into, and Gaussians over them, with a floor.

Components of the joint state: sets of nodes that are correlated among themselves and with no others.

    P = blockdiag( P_1, ..., P_C )       one dense block a component

Interactions join components; between components every covariance is exactly zero and is neither stored nor computed.
Components of equal size are stacked, so that all of them take one batched operation.

A covariance that is not smaller than another one: what is reported of nodes whose solution has not settled.

Where the minimum of the graph is not found, the curvature at the point reached says nothing of the error there.
What measurements took from the predicted covariance P_0 is given back in every direction in which P is smaller,

    P + L (I - M)_+ L^T,      P_0 = L L^T,      M = L^-1 P L^-T

where (.)_+ keeps the positive eigenvalues. This is >= P_0 and >= P, positive definite, the smallest such change in
units of P_0, and the same in all units. The correlations with other nodes stay as they are.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError, UnknownNodeError
from saga_fg.kernels.components import component_tables, regrouped_blocks, uncorrelated_labels, united_labels
from saga_fg.numerics import (
    BoolArray,
    FloatArray,
    IntArray,
    checked,
    checked_covariances,
    checked_ids,
    checked_rows,
    unchecked,
)

MAX_DIM = 1000  # of the state of one node: far above those of objects, poses and landmarks


@dataclass(frozen=True, eq=False)
class StateLayout:
    """Ids of the nodes (n,) in order, the sizes of their states (n,), and their places in the joint state (n + 1,)."""

    nodes: IntArray = ()  # type: ignore[assignment]  # arrays from construction on
    dims: IntArray = ()  # type: ignore[assignment]
    offsets: IntArray = field(init=False)

    def __post_init__(self) -> None:
        nodes, dims = checked_ids("nodes", self.nodes), checked_rows("dims", self.dims, len(self.nodes))
        if len(dims) and not 1 <= dims.min() <= dims.max() <= MAX_DIM:
            raise InputError(f"dims: expected sizes of states of 1 to {MAX_DIM}, got {dims.min()} to {dims.max()}")
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
        dims = self.dims[rows]
        begins = np.cumsum(dims) - dims
        return np.asarray(np.repeat(self.offsets[rows] - begins, dims) + np.arange(dims.sum()))

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


UNCORRELATED = 1e-12  # correlations below this have decayed to nothing: a share of the mean error, in sigmas


@dataclass(frozen=True, eq=False)
class BlockGaussian:
    """partition of the nodes; mean (D,); blocks of the covariance, one group of components each."""

    partition: Partition
    mean: FloatArray
    blocks: BlockDiagonal

    @staticmethod
    def empty() -> BlockGaussian:
        """Gaussian of no node."""
        return BlockGaussian(Partition.apart(StateLayout()), np.empty(0), ())

    @staticmethod
    def from_dense(nodes: ArrayLike, sizes: ArrayLike, mean: ArrayLike, covariance: ArrayLike) -> BlockGaussian:
        """Gaussian of nodes (n,), whose states have `sizes` (n,), from its mean (D,) and covariance (D, D).

        Nodes are independent where the covariance is zero. Raises `InputError` for wrong shapes and numbers that are
        not finite.
        """
        layout = StateLayout(np.asarray(nodes), np.asarray(sizes))  # which checks them
        mean = checked("mean", mean, (layout.size,))
        P = checked("covariance", covariance, (layout.size, layout.size))
        if len(layout) == 0:
            return BlockGaussian.empty()
        together = BlockGaussian(Partition(layout, np.zeros(len(layout), dtype=np.int64)), mean, (P[None],))
        return together.over(together.uncorrelated(0.0))

    def check_shapes(self) -> None:
        """Raise `InputError` unless mean and blocks are of the sizes of the partition: kernels rely on it."""
        shapes = [(*places.shape, places.shape[1]) for places in self.partition.groups]
        if self.mean.shape != (self.layout.size,) or [block.shape for block in self.blocks] != shapes:
            raise InputError(f"state: expected a mean of {self.layout.size} numbers and blocks of {shapes}")

    @property
    def layout(self) -> StateLayout:
        return self.partition.layout

    @property
    def flat(self) -> FloatArray:
        """The blocks one after the other, as kernels take them."""
        return flattened(self.blocks)

    def over(self, partition: Partition) -> BlockGaussian:
        """Change the partition; nodes that it separates lose their correlation."""
        if partition is self.partition or np.array_equal(partition.label, self.partition.label):
            return self
        rows = np.arange(len(self.layout))
        return BlockGaussian(partition, self.mean, regrouped(self.blocks, self.partition, partition, rows))

    def extended(self, layout: StateLayout, means: FloatArray, covariances: FloatArray) -> BlockGaussian:
        """Add the further nodes of `layout`, independent of all others: means (k, d), covariances (k, d, d)."""
        if len(means) == 0:
            return self
        sizes, size = [places.shape[1] for places in self.partition.groups], covariances.shape[1]
        at, blocks = bisect_left(sizes, size), list(self.blocks)
        if size in sizes:  # components of one size are in the order of their first nodes
            blocks[at] = np.concatenate([blocks[at], covariances])
        else:
            blocks.insert(at, np.array(covariances))
        return BlockGaussian(self.partition.extended(layout), np.concatenate([self.mean, means.ravel()]), tuple(blocks))

    def without(self, rows: IntArray) -> BlockGaussian:
        """Integrate out the nodes at `rows`."""
        if len(rows) == 0:
            return self
        keep = np.ones(len(self.layout), dtype=bool)
        keep[rows] = False
        kept = keep.nonzero()[0]
        old = self.partition
        partition = old.restricted(self.layout.without(rows), kept)
        blocks = regrouped(self.blocks, old, partition, kept)
        return BlockGaussian(partition, self.mean[self.layout.places(kept)], blocks)

    def only(self, nodes: IntArray) -> BlockGaussian:
        """Integrate out all but some nodes."""
        return self.without(np.flatnonzero(~np.isin(self.layout.nodes, nodes)))

    def decoupled(self) -> BlockGaussian:
        """Separate the parts of components that are no longer correlated, long after the last interaction."""
        return self.over(self.uncorrelated(UNCORRELATED))

    def uncorrelated(self, tolerance: float) -> Partition:
        """The partition into parts that no correlation above `tolerance` ties."""
        if self.partition.count == len(self.layout):
            return self.partition
        layout, label, at = self.layout, self.partition.label, self.partition.block_places
        joined = uncorrelated_labels(self.flat, label, at.start, at.size, at.offset, layout.dims, tolerance)
        parts = Partition(layout, joined)
        return self.partition if parts.count == self.partition.count else parts

    def means_of(self, nodes: ArrayLike) -> FloatArray:
        """(k, d) means of nodes of equal size d, by their ids."""
        return np.asarray(self.mean[self.layout.spans(self.layout.rows(nodes))])

    def covariances_of(self, nodes: ArrayLike) -> FloatArray:
        """(k, d, d) covariances of nodes of equal size d, by their ids."""
        rows = self.layout.rows(nodes)
        self.layout.spans(rows)  # states of equal size, or an error that says so
        return self.covariances(rows)

    def covariances(self, rows: IntArray) -> FloatArray:
        """(k, d, d) of the nodes at `rows`, whose states have equal size d."""
        return self.between(rows, rows)

    def joint(self, rows: IntArray) -> FloatArray:
        """Joint covariance of the nodes at `rows`, in this order, of any sizes."""
        if len(rows) == 0:
            return np.empty((0, 0))
        some = StateLayout(np.arange(len(rows)), self.layout.dims[rows])
        together = Partition(some, np.zeros(len(rows), dtype=np.int64))
        return np.asarray(regrouped(self.blocks, self.partition, together, rows)[0][0])

    def correlated(self, rows: IntArray) -> tuple[IntArray, IntArray]:
        """Pairs of the nodes `rows` (k,), distinct, that share a component: first < second (E,), places in `rows`."""
        label = self.partition.label[rows]
        order = np.argsort(label, kind="stable")
        count = np.bincount(label, minlength=self.partition.count)
        later = (np.cumsum(count) - 1)[label[order]] - np.arange(len(rows))  # of the component, after each of them
        first = np.repeat(np.arange(len(rows)), later)
        second = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(later) - later, later)
        return order[first], order[second]

    def between(self, first: IntArray, second: IntArray) -> FloatArray:
        """Covariances (E, a, b) of nodes `first` (E,) of size a with `second` of size b, of the same components."""
        dims, place = self.layout.dims, self.partition.block_places
        a, b = (int(dims[rows[0]]) if len(rows) else 0 for rows in (first, second))
        corner = place.start[first] + place.size[first] * place.offset[first] + place.offset[second]
        row = place.size[first][:, None, None] * np.arange(a)[:, None]
        return np.asarray(self.flat[corner[:, None, None] + row + np.arange(b)])

    def variances(self) -> FloatArray:
        """(D,)"""
        variances = np.empty(len(self.mean))
        for places, P in zip(self.partition.groups, self.blocks, strict=True):
            variances[places] = np.diagonal(P, axis1=1, axis2=2)
        return variances


def not_smaller(x: BlockGaussian, least: BlockGaussian, nodes: IntArray) -> BlockGaussian:
    """`x` with a joint covariance of some nodes that is, by components, not smaller than theirs in `least`.

    Nodes that `least` does not have stay as they are.
    """
    rows, blocks = x.layout.rows(nodes[np.isin(nodes, least.layout.nodes)]), [block.copy() for block in x.blocks]
    partition = x.partition
    for label in np.unique(partition.label[rows]).tolist():
        mine = rows[partition.label[rows] == label]
        deficit = missing_covariance(x.joint(mine), least.joint(least.layout.rows(x.layout.nodes[mine])))
        spans = [partition.offset[row] + np.arange(x.layout.dims[row]) for row in mine.tolist()]
        places, block = np.concatenate(spans), blocks[partition.group[mine[0]]][partition.row[mine[0]]]
        block[np.ix_(places, places)] += deficit
    return BlockGaussian(partition, x.mean, tuple(blocks))


def missing_covariance(P: FloatArray, least: FloatArray) -> FloatArray:
    """(d, d) what P (d, d) needs at least to be not smaller than `least` (d, d)."""
    try:
        L = np.linalg.cholesky(least)
    except np.linalg.LinAlgError:  # a direction without variance
        return least
    half = np.linalg.solve(L, P)
    M = np.linalg.solve(L, half.T)
    eigenvalues, V = np.linalg.eigh((M + M.T) / 2)
    root = L @ (V * np.sqrt(np.maximum(1.0 - eigenvalues, 0.0)))
    return np.asarray(root @ root.T)

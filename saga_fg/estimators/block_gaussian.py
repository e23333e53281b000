"""Gaussians over the joint state whose covariance is block-diagonal by components, and a floor for one.

A covariance that is not smaller than another one: what is reported of nodes whose solution has not settled.

Where the minimum of the graph is not found, the curvature at the point reached says nothing of the error there.
What measurements took from the predicted covariance P_0 is given back in every direction in which P is smaller,

    P + L (I - M)_+ L^T,      P_0 = L L^T,      M = L^-1 P L^-T

where (.)_+ keeps the positive eigenvalues. This is >= P_0 and >= P, positive definite, the smallest such change in
units of P_0, and the same in all units. The correlations with other nodes stay as they are.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.estimators.partition import BlockDiagonal, Partition, StateLayout, flattened, regrouped
from saga_fg.kernels.components import uncorrelated_labels
from saga_fg.numerics.arrays import FloatArray, IntArray, checked

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
        mean: FloatArray = self.mean[self.layout.spans(self.layout.rows(nodes))]
        return mean

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
        joint: FloatArray = regrouped(self.blocks, self.partition, together, rows)[0][0]
        return joint

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
        block: FloatArray = self.flat[corner[:, None, None] + row + np.arange(b)]
        return block

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
    if len(rows) == 0:
        return x
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

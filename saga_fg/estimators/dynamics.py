"""Prediction of a joint state by components, and bounds on which correlations it keeps.

    m <- F m + b        P <- F P F^T + Q        F block-sparse, Q block-diagonal

A component grows by the interactions that enter it; all of one size are predicted by one batched operation.

Bounds on the components of a joint state, for speed: which correlations a prediction leaves out.

    x_i' = sum_{j with i} F_ij x_j + sum_{j not with i} F_ij x_j + b_i + q_i        i and j are "with" in one component

A node j of another component is an independent input: F_ij m_j is taken over exactly, F_ij P_jj F_ij^T is further noise
of x_i', and the correlation of the two is left out. Covariances are blocks of exact ones, and stay positive definite.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse

from saga_fg.errors import InputError, require_type
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.partition import BlockDiagonal, Partition, StateLayout
from saga_fg.model.discretisation import Blocks, Transition
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray

_SPARSE_FROM = 100  # size of a component from which its part of F is kept sparse
_AT_ONCE = 25_000  # entries of components that are multiplied at once


@dataclass(frozen=True, eq=False)
class Dynamics:
    """x <- F x + b + q, q ~ N(0, Q) over the nodes of `layout` in its order; see
    `saga_fg.model.discretisation.Transition`."""

    layout: StateLayout
    F: tuple[Blocks, ...]
    b: FloatArray
    Q: tuple[Blocks, ...]

    @staticmethod
    def of(transition: Transition, layout: StateLayout) -> Dynamics:
        """Dynamics of a transition over exactly the nodes of `layout`; raises `InputError` for any other."""
        require_type("transition", transition, Transition)
        rows = layout.rows(transition.nodes)
        if len(rows) != len(layout):
            raise InputError(f"transition: expected {len(layout)} nodes, got {len(rows)}")
        if (layout.dims[rows] != transition.graph.dims).any():
            raise InputError("transition: the sizes of its states differ from those of the estimator")
        if (rows == np.arange(len(rows))).all():
            return Dynamics(layout, transition.F, transition.b, transition.Q)
        b = np.empty(layout.size)
        b[layout.places(rows)] = transition.b
        return Dynamics(layout, _renamed(transition.F, rows), b, _renamed(transition.Q, rows))

    def with_static(self, layout: StateLayout, others: IntArray) -> Dynamics:
        """Extend to `layout`, which has further nodes at the rows `others`: these stay as they are."""
        rows, b = np.delete(np.arange(len(layout)), others), np.zeros(layout.size)
        b[layout.places(rows)] = self.b
        return Dynamics(layout, (*_renamed(self.F, rows), *identity(layout, others)), b, _renamed(self.Q, rows))

    def restricted(self, rows: IntArray) -> Dynamics:
        """Restrict to the nodes at `rows`, ascending, on which no others act; itself if these are all."""
        if len(rows) == len(self.layout):
            return self
        kept = np.zeros(len(self.layout), dtype=bool)
        kept[rows] = True
        some = replace(self, F=_where(kept, self.F), Q=_where(kept, self.Q))
        where = np.full(len(self.layout), -1)
        where[rows] = np.arange(len(rows))
        layout = self.layout.select(rows)
        return Dynamics(layout, _renamed(some.F, where), self.b[self.layout.places(rows)], _renamed(some.Q, where))

    def times(self, x: FloatArray) -> FloatArray:
        """F x of a joint state (D,)."""
        starts, result = self.layout.offsets[:-1], np.zeros(self.layout.size)
        for F in self.F:
            _, d_i, d_j = F.values.shape
            products = F.values @ x[starts[F.source][:, None] + np.arange(d_j)][:, :, None]
            at = starts[F.target][:, None] + np.arange(d_i)
            result += np.bincount(at.ravel(), weights=products.ravel(), minlength=len(result))
        return result

    def transpose_times(self, r: FloatArray) -> FloatArray:
        """F^T r of a gradient (D,)."""
        starts, result = self.layout.offsets[:-1], np.zeros(self.layout.size)
        for F in self.F:
            _, d_i, d_j = F.values.shape
            products = r[starts[F.target][:, None] + np.arange(d_i)][:, None] @ F.values
            at = starts[F.source][:, None] + np.arange(d_j)
            result += np.bincount(at.ravel(), weights=products.ravel(), minlength=len(result))
        return result

    @cached_property
    def matrix(self) -> scipy.sparse.csr_array:
        """F (D, D), sparse."""
        return _sparse(self.F, self.layout.offsets[:-1], self.layout.size)

    @property
    def unchanged(self) -> BoolArray:
        """(n,) true for nodes that stay exactly as they are, x' = x without noise, whatever the others do."""
        n = len(self.layout)
        same, driven = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
        for F in self.F:
            own = F.target == F.source
            same[F.target[own & (F.values == np.eye(*F.values.shape[1:])).all(axis=(1, 2))]] = True
            driven[F.target[~own & F.values.any(axis=(1, 2))]] = True
        for Q in self.Q:
            driven[Q.target[Q.values.any(axis=(1, 2))]] = True
        driven[np.repeat(np.arange(n), self.layout.dims)[self.b != 0]] = True
        return same & ~driven

    def joined(self, partition: Partition) -> Partition:
        """The components that a prediction leaves of those of `partition`."""
        if not self.F:
            return partition
        target = np.concatenate([blocks.target for blocks in self.F])
        source = np.concatenate([blocks.source for blocks in self.F])
        return partition.joined(target, source)

    def separated(self, x: BlockGaussian) -> BlockGaussian:
        """Separate the uncorrelated parts of components that no interaction of this interval ties."""
        tied = self.joined(Partition.apart(x.layout))
        return x if tied.count == self.joined(x.partition).count else x.decoupled()

    def propagated(self, x: BlockGaussian) -> tuple[FloatArray, BlockDiagonal]:
        """F m and the blocks of F P F^T, for components that F does not leave."""
        mean, blocks = np.empty_like(x.mean), []
        for number, (places, P) in enumerate(zip(x.partition.groups, x.blocks, strict=True)):
            if P.shape[1] < _SPARSE_FROM:
                product, some = np.empty_like(P), max(1, _AT_ONCE // P[0].size)
                for part in (slice(k, k + some) for k in range(0, len(P), some)):
                    F = self._dense(x.partition, number, part)
                    mean[places[part]] = (F @ x.mean[places[part]][:, :, None])[:, :, 0]
                    product[part] = _symmetric(F @ P[part] @ np.swapaxes(F, 1, 2))
            else:
                product = np.empty_like(P)
                for component, factor in enumerate(self._components(x.partition, number)):
                    mean[places[component]] = factor @ x.mean[places[component]]
                    product[component] = factor @ np.ascontiguousarray((factor @ P[component]).T)
                product = _symmetric(product)
            blocks.append(product)
        return mean, tuple(blocks)

    def pulled_back(self, partition: Partition, blocks: BlockDiagonal) -> BlockDiagonal:
        """F^T X F of a block-diagonal symmetric X, over a partition whose components F does not leave."""
        result = []
        for number, X in enumerate(blocks):
            if X.shape[1] < _SPARSE_FROM:
                F = self._dense(partition, number, slice(0, len(X)))
                product = np.swapaxes(F, 1, 2) @ X @ F
            else:
                product = np.empty_like(X)
                for component, factor in enumerate(self._components(partition, number)):
                    left = factor.T.tocsr()
                    product[component] = left @ np.ascontiguousarray((left @ X[component]).T)
            result.append(_symmetric(product))
        return tuple(result)

    def add_noise(self, partition: Partition, blocks: BlockDiagonal) -> None:
        """Add Q to the diagonal blocks of `blocks`, in place."""
        for noise in self.Q:
            if partition.size and len(partition.groups) == 1:
                row, slot = partition.row[noise.target], partition.slot[noise.target]
                partition.by_nodes(blocks[0])[row, slot, slot] += noise.values
                continue
            for number, members, at in partition.members(noise.target, noise.values.shape[1]):
                row = partition.row[noise.target[members]]
                blocks[number][row[:, None, None], at[:, :, None], at[:, None, :]] += noise.values[members]

    def _dense(self, partition: Partition, number: int, part: slice) -> FloatArray:
        """F of some components of a group, (c, s, s)."""
        places = partition.groups[number]
        F = np.zeros((*places[part].shape, places.shape[1]))
        for blocks in self.F:
            _, d_i, d_j = blocks.values.shape
            target, source, values = blocks.target, blocks.source, blocks.values
            if len(partition.groups) > 1 or len(F) < len(places):
                row = partition.row[target]
                mine = (partition.group[target] == number) & (row >= part.start) & (row < part.stop)
                members = np.flatnonzero(mine)
                target, source, values = target[members], source[members], values[members]
            row = partition.row[target] - part.start
            if partition.size:
                partition.by_nodes(F)[row, partition.slot[target], partition.slot[source]] = values
                continue
            i = partition.offset[target][:, None, None] + np.arange(d_i)[:, None]
            j = partition.offset[source][:, None, None] + np.arange(d_j)
            F[row[:, None, None], i, j] = values
        return F

    def _components(self, partition: Partition, number: int) -> list[scipy.sparse.csr_array]:
        """F of each component of a group, sparse (s, s)."""
        count, size = partition.groups[number].shape
        if size == self.layout.size:
            return [self.matrix]
        parts = []
        for row in range(count):
            blocks = []
            for group in self.F:
                mine = (partition.group[group.target] == number) & (partition.row[group.target] == row)
                blocks.append(Blocks(group.target[mine], group.source[mine], group.values[mine]))
            parts.append(_sparse(tuple(blocks), partition.offset, size))
        return parts


def predict(x: BlockGaussian, dynamics: Dynamics, partition: Partition | None = None) -> BlockGaussian:
    """The prior after the interval. Raises `InputError` where it is not finite.

    partition: components that F does not leave; nodes that it separates lose their correlation. None: those joined by F
    """
    x = x.over((dynamics.joined(x.partition) if partition is None else partition).packed)
    partition = x.partition
    mean, blocks = dynamics.propagated(x)
    mean += dynamics.b
    dynamics.add_noise(partition, blocks)
    if not (np.isfinite(mean).all() and all(np.isfinite(block).all() for block in blocks)):
        raise InputError("transition: the prediction is not finite, the dynamics grow beyond all numbers")
    return BlockGaussian(partition, mean, blocks)


def identity(layout: StateLayout, rows: IntArray) -> tuple[Blocks, ...]:
    """Blocks of the nodes at `rows` that stay as they are."""
    alike = [rows[layout.dims[rows] == d] for d in np.unique(layout.dims[rows])]
    return tuple(Blocks(k, k, np.tile(np.eye(layout.dims[k[0]]), (len(k), 1, 1))) for k in alike)


def _symmetric(product: FloatArray) -> FloatArray:
    """Remove the asymmetry that rounding leaves in a stack."""
    symmetric = product + np.swapaxes(product, 1, 2)
    symmetric *= 0.5
    return np.asarray(symmetric)


def _where(kept: BoolArray, groups: tuple[Blocks, ...]) -> tuple[Blocks, ...]:
    """The blocks between nodes that are kept."""
    chosen = ((blocks, kept[blocks.target] & kept[blocks.source]) for blocks in groups)
    return tuple(
        Blocks(blocks.target[mine], blocks.source[mine], blocks.values[mine]) for blocks, mine in chosen if mine.any()
    )


def _renamed(groups: tuple[Blocks, ...], rows: IntArray) -> tuple[Blocks, ...]:
    return tuple(Blocks(rows[blocks.target], rows[blocks.source], blocks.values) for blocks in groups)


def _sparse(groups: tuple[Blocks, ...], starts: IntArray, size: int) -> scipy.sparse.csr_array:
    """The matrix (size, size) of blocks whose nodes begin at `starts`."""
    rows, columns, values = [], [], []
    for blocks in groups:
        _, d_i, d_j = blocks.values.shape
        i = starts[blocks.target][:, None, None] + np.arange(d_i)[:, None]
        j = starts[blocks.source][:, None, None] + np.arange(d_j)
        rows.append(np.broadcast_to(i, blocks.values.shape).ravel())
        columns.append(np.broadcast_to(j, blocks.values.shape).ravel())
        values.append(blocks.values.ravel())
    if not rows:
        return scipy.sparse.csr_array((size, size))
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    matrix = scipy.sparse.csr_array(entries, shape=(size, size))
    matrix.eliminate_zeros()  # blocks are mostly zeros: a neighbour's velocity says nothing across the axes
    return matrix


def noise_ratio(P: FloatArray, Q: FloatArray) -> FloatArray:
    """(m,) size of covariances P (m, d, d) in units of noise Q (m, d, d), the trace of Q^-1 P; infinite without any."""
    try:
        L = np.linalg.cholesky(Q)
    except np.linalg.LinAlgError:
        if len(Q) == 1:
            return np.array([np.inf])
        half = len(Q) // 2
        return np.concatenate([noise_ratio(P[:half], Q[:half]), noise_ratio(P[half:], Q[half:])])
    half_done = np.linalg.solve(L, P)
    return np.asarray(np.trace(np.linalg.solve(L, np.swapaxes(half_done, 1, 2)), axis1=1, axis2=2))


@dataclass(frozen=True)
class ComponentBounds:
    """Nodes that become, or remain, one component.

    tolerance  correlation up to which nodes count as independent
    most       largest number of nodes of a component; the strongest ties come first
    """

    tolerance: float
    most: int

    def applied(self, x: BlockGaussian, dynamics: Dynamics) -> tuple[Dynamics, Partition]:
        """The dynamics with inputs, and the components they leave."""
        parts = x.uncorrelated(self.tolerance)
        a, b, strength = _ties(x, dynamics, parts)
        strong = np.flatnonzero(strength > self.tolerance)
        strong = strong[np.argsort(-strength[strong], kind="stable")]
        partition = parts.joined_up_to(a[strong], b[strong], self.most)
        return _with_inputs(x, dynamics, partition), partition


def checked_most(most: int | None) -> int | None:
    """Raise `InputError` unless it is a number of nodes, or None."""
    if most is not None and (isinstance(most, bool) or not isinstance(most, int) or most < 1):
        raise InputError(f"max_component: expected a whole number of nodes >= 1, got {most!r}")
    return most


def _ties(x: BlockGaussian, dynamics: Dynamics, partition: Partition) -> tuple[IntArray, IntArray, FloatArray]:
    """Blocks F_ij between components of `partition`: labels of those of i and j, and how the nodes would correlate.

    That is the largest correlation of F_ij x_j with x_j, in deviations of x_i and x_j before the interval.
    """
    starts, sigma = x.layout.offsets[:-1], np.sqrt(x.variances())
    found: list[tuple[IntArray, IntArray, FloatArray]] = []
    for _, blocks, across in _between(dynamics, partition):
        target, source, values = blocks.target[across], blocks.source[across], blocks.values[across]
        _, d_i, d_j = values.shape
        by_i = sigma[starts[target][:, None] + np.arange(d_i)][:, :, None]
        by_j = sigma[starts[source][:, None] + np.arange(d_j)][:, None, :]
        strength = np.abs(values @ x.covariances(source) / (by_i * by_j)).max(axis=(1, 2))
        found.append((partition.label[target], partition.label[source], strength))
    none = np.empty(0, dtype=np.int64)
    a, b, strength = zip((none, none, np.empty(0)), *found, strict=True)
    return np.concatenate(a), np.concatenate(b), np.concatenate(strength)


def _with_inputs(x: BlockGaussian, dynamics: Dynamics, partition: Partition) -> Dynamics:
    """Nodes of other components of `partition` as independent inputs."""
    starts, F, Q, b = x.layout.offsets[:-1], list(dynamics.F), list(dynamics.Q), dynamics.b.copy()
    for number, blocks, across in _between(dynamics, partition):
        target, source, values = blocks.target[across], blocks.source[across], blocks.values[across]
        _, d_i, d_j = values.shape
        kept = np.ones(len(blocks.target), dtype=bool)
        kept[across] = False
        F[number] = Blocks(blocks.target[kept], blocks.source[kept], blocks.values[kept])
        inputs = values @ x.mean[starts[source][:, None] + np.arange(d_j)][:, :, None]
        np.add.at(b, starts[target][:, None] + np.arange(d_i), inputs[:, :, 0])
        rows, index = np.unique(target, return_inverse=True)
        noise = np.zeros((len(rows), d_i, d_i))
        np.add.at(noise, index, values @ x.covariances(source) @ np.swapaxes(values, 1, 2))
        Q.append(Blocks(rows, rows, noise))
    return dynamics if len(Q) == len(dynamics.Q) else replace(dynamics, F=tuple(F), b=b, Q=tuple(Q))


def _between(dynamics: Dynamics, partition: Partition) -> list[tuple[int, Blocks, IntArray]]:
    """Blocks between components of a partition: the number of their group, the group, which of it."""
    label = partition.label
    found = ((k, F, np.flatnonzero(label[F.target] != label[F.source])) for k, F in enumerate(dynamics.F))
    return [(number, blocks, across) for number, blocks, across in found if len(across)]

"""The discrete dynamics of one interval, block-sparse like the graph it came from.

x(t + dt) = F x(t) + b + q,    q ~ N(0, Q),    Q block-diagonal, one block a node
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse

from saga_fg.errors import InputError
from saga_fg.model.scene_graph import SceneGraph
from saga_fg.numerics.arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Blocks:
    """Equal-sized blocks of a block-sparse matrix: block k couples node row target[k] to node row source[k].

    target (m,), source (m,), values (m, d_i, d_j)
    """

    target: IntArray
    source: IntArray
    values: FloatArray


@dataclass(frozen=True, eq=False)
class Transition:
    """Discrete dynamics of the nodes of `graph` over `dt` seconds; made by `saga_fg.model.discretisation.discretise`.

    graph   the frozen record it was made from (nodes, order and sizes of the states)
    dt      s
    F       blocks of the transition matrix, each (target, source) pair at most once
    b       (D,) affine term
    Q       blocks of the process noise, all on the diagonal, every node exactly once

    Raises `InputError` for blocks that do not fit the nodes, and for numbers that are not finite: the dynamics have
    grown beyond all bounds within dt.
    """

    graph: SceneGraph
    dt: float
    F: tuple[Blocks, ...]
    b: FloatArray
    Q: tuple[Blocks, ...]

    def __post_init__(self) -> None:
        what = f"transition over {self.dt:g} s"
        if np.shape(self.b) != (int(self.offsets[-1]),):
            raise InputError(f"{what}: b: expected {int(self.offsets[-1])} entries, got shape {np.shape(self.b)}")
        for name, groups in (("F", self.F), ("Q", self.Q)):
            for group in groups:
                d_i, d_j = group.values.shape[1:]
                if (self.graph.dims[group.target] != d_i).any() or (self.graph.dims[group.source] != d_j).any():
                    raise InputError(
                        f"{what}: {name}: blocks of size {d_i} x {d_j} do not fit the states of their nodes"
                    )
        noisy = np.concatenate([group.target for group in self.Q]) if self.Q else np.empty(0, dtype=np.int64)
        if not np.array_equal(np.sort(noisy), np.arange(len(self.graph))):
            raise InputError(f"{what}: Q: expected one block for each of {len(self.graph)} nodes")
        self.check_finite()

    def check_finite(self) -> None:
        """Raise `InputError` unless all numbers are finite."""
        for name, parts in (("b", [self.b]), ("F", [F.values for F in self.F]), ("Q", [Q.values for Q in self.Q])):
            if not all(np.isfinite(values).all() for values in parts):
                raise InputError(f"transition over {self.dt:g} s: {name}: expected finite numbers")

    @property
    def nodes(self) -> IntArray:
        """(n,) ids, in the order of the state."""
        return self.graph.nodes

    @cached_property
    def offsets(self) -> IntArray:
        """(n + 1,) where each node's state begins in the joint state; the last entry is its size D."""
        return np.concatenate([[0], np.cumsum(self.graph.dims)]).astype(np.int64)

    @cached_property
    def F_matrix(self) -> scipy.sparse.csr_matrix:
        """(D, D), sparse."""
        return self._assemble(self.F)

    @cached_property
    def Q_matrix(self) -> scipy.sparse.csr_matrix:
        """(D, D), sparse, block-diagonal."""
        return self._assemble(self.Q)

    def _assemble(self, groups: tuple[Blocks, ...]) -> scipy.sparse.csr_matrix:
        D = int(self.offsets[-1])
        rows, columns, values = [], [], []
        for group in groups:
            _, d_i, d_j = group.values.shape
            r = self.offsets[group.target][:, None, None] + np.arange(d_i)[None, :, None]
            c = self.offsets[group.source][:, None, None] + np.arange(d_j)[None, None, :]
            rows.append(np.broadcast_to(r, group.values.shape).ravel())
            columns.append(np.broadcast_to(c, group.values.shape).ravel())
            values.append(group.values.ravel())
        if not rows:
            return scipy.sparse.csr_matrix((D, D))
        coordinates = (np.concatenate(rows), np.concatenate(columns))
        return scipy.sparse.csr_matrix((np.concatenate(values), coordinates), shape=(D, D))

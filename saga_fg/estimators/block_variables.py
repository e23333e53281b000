r"""The variables of the iSAM2 filter, and the linear factors on them.

A variable is the stacked state of some correlated nodes, a whole component or a part of a large one: elimination works
on blocks that are worth a call to the linear algebra. Its unit is the standard deviation, its zero its first
estimate,

    x = origin + scale y,

so that information matrices have entries of order one and estimates are small numbers. In it, with W W^T = noise^-1,

    interaction  || W ( x' - F x - b ) ||^2     one factor a variable, with all variables that act on it
    detection    || W ( z - H x ) ||^2          one factor a variable
    prior        || W ( x - origin ) ||^2       one factor a component
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.csgraph

from factors.gaussian import native_factor
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.correction import rank
from saga_fg.estimators.dynamics import Dynamics
from saga_fg.estimators.layout import StateLayout
from saga_fg.estimators.measurements import WhitenedMeasurements
from saga_fg.estimators.partition import Partition, unflattened
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray

_WHOLE = 64  # size of a component up to which it is one variable
_PART = 24  # size of the variables of a larger one


@dataclass(frozen=True, eq=False)
class BlockVariables:
    """partition of the nodes into variables; keys (c,) of these; origin, scale (D,): see the module."""

    partition: Partition
    keys: IntArray
    origin: FloatArray
    scale: FloatArray

    @staticmethod
    def over(
        components: Partition, first_key: int, origin: FloatArray, scale: FloatArray, dynamics: Dynamics | None = None
    ) -> BlockVariables:
        """New variables for the nodes of `components`, with keys from `first_key` on.

        Large components are cut so that nodes next to each other in the graph of `dynamics` share a variable.
        """
        partition = _divided(components, dynamics)
        return BlockVariables(partition, first_key + np.arange(partition.count), origin, scale)

    def extended(self, layout: StateLayout, means: FloatArray, scale: FloatArray, first_key: int) -> BlockVariables:
        """Add the further nodes of `layout`, each a variable of its own."""
        partition = self.partition.extended(layout)
        keys = np.concatenate([self.keys, first_key + np.arange(partition.count - len(self.keys))])
        return BlockVariables(
            partition, keys, np.concatenate([self.origin, means]), np.concatenate([self.scale, scale])
        )

    @cached_property
    def sizes(self) -> IntArray:
        """(c,) size of each variable's state."""
        sizes = np.bincount(self.partition.label, weights=self.partition.layout.dims, minlength=len(self.keys))
        return sizes.astype(np.int64)

    def dims(self, nodes: BoolArray) -> dict[int, int]:
        """Size of each variable of some nodes (n,), by key."""
        chosen = np.unique(self.partition.label[nodes])
        return dict(zip(self.keys[chosen].tolist(), self.sizes[chosen].tolist(), strict=True))

    def priors(self, x: BlockGaussian, rows: IntArray) -> list[gtsam.JacobianFactor]:
        """One factor a component of `x`, whose nodes are at `rows` here; no variable belongs to two components."""
        here = self.partition.layout.places(rows)
        factors = []
        for places, P in zip(x.partition.groups, x.blocks, strict=True):
            W = np.linalg.inv(np.linalg.cholesky(P))
            for component, whitener in zip(here[places], W, strict=True):
                order, variables = self._variables_of(component)
                augmented = np.zeros((len(component), len(component) + 1), order="F")
                augmented[:, :-1] = whitener[:, order] * self.scale[component[order]]
                factors.append(native_factor(self.keys[variables].tolist(), self.sizes[variables].tolist(), augmented))
        return factors

    def detections(self, white: WhitenedMeasurements) -> list[gtsam.JacobianFactor]:
        """One factor a variable for the measurements of its nodes."""
        rows, z, H = white.rows, white.z, white.H
        partition, (_, k, d) = self.partition, H.shape
        span = partition.layout.offsets[rows][:, None] + np.arange(d)
        A = H * self.scale[span][:, None, :]
        rhs = z - (H @ self.origin[span][:, :, None])[:, :, 0]
        number, variable, counts = np.unique(partition.label[rows], return_inverse=True, return_counts=True)
        size = self.sizes[number]
        base = np.concatenate([[0], np.cumsum((size + 1) * counts * k)])
        flat = np.zeros(base[-1])  # every factor's matrix, transposed, one after the other
        row = rank(variable)[:, None] * k + np.arange(k)
        at = base[variable][:, None, None] + row[:, None, :]
        width = (counts * k)[variable][:, None, None]
        flat[at + (partition.offset[rows][:, None] + np.arange(d))[:, :, None] * width] = np.swapaxes(A, 1, 2)
        flat[at + size[variable][:, None, None] * width] = rhs[:, None, :]
        return [
            native_factor([key], [s], flat[begin:end].reshape(s + 1, -1).T)
            for key, s, begin, end in zip(
                self.keys[number].tolist(), size.tolist(), base[:-1].tolist(), base[1:].tolist(), strict=True
            )
        ]

    def interactions(self, before: BlockVariables, rows: IntArray, dynamics: Dynamics) -> list[gtsam.JacobianFactor]:
        """One factor a variable with dynamics, with the variables `before`, in which the nodes are at `rows`."""
        layout, new, old = self.partition.layout, self.partition, before.partition
        if not dynamics.F:
            return []
        target = np.concatenate([blocks.target for blocks in dynamics.F])
        source = rows[np.concatenate([blocks.source for blocks in dynamics.F])]
        pairs, pair = np.unique(new.label[target] * len(before.keys) + old.label[source], return_inverse=True)
        target_variable, source_variable = np.divmod(pairs, len(before.keys))  # variables, sorted by target_variable
        width = before.sizes[source_variable]
        first = np.searchsorted(target_variable, np.arange(len(self.keys) + 1))
        ends = np.concatenate([[0], np.cumsum(width)])
        column = (
            self.sizes[target_variable] + ends[:-1] - ends[first[target_variable]]
        )  # where each pair's block begins
        columns = self.sizes + ends[first[1:]] - ends[first[:-1]]
        base = np.concatenate([[0], np.cumsum((columns + 1) * self.sizes)])
        flat = np.zeros(base[-1])  # every factor's matrix, transposed, one after the other

        def put(values: FloatArray, node: IntArray, column: IntArray) -> None:
            """Write values (m, d_i, d_j) to the rows of node rows `node` and from `column` on."""
            variable = new.label[node]
            _, d_i, d_j = values.shape
            at = (
                base[variable][:, None, None]
                + (column[:, None, None] + np.arange(d_j)) * self.sizes[variable][:, None, None]
            )
            flat[at + (new.offset[node][:, None, None] + np.arange(d_i)[:, None])] = values

        W = {d: np.zeros((len(layout), d, d)) for d in np.unique(layout.dims).tolist()}
        left_over = dynamics.times(before.origin[before.partition.layout.places(rows)]) + dynamics.b - self.origin
        for noise in dynamics.Q:
            node, d = noise.target, noise.values.shape[1]
            W[d][node] = np.linalg.inv(np.linalg.cholesky(noise.values))
            span = layout.offsets[node][:, None] + np.arange(d)
            put(W[d][node] * self.scale[span][:, None, :], node, new.offset[node])
            put(W[d][node] @ left_over[span][:, :, None], node, columns[new.label[node]])
        done = 0
        for blocks in dynamics.F:
            m, d_i, d_j = blocks.values.shape
            mine, i = slice(done, done + m), blocks.target
            j, done = source[mine], done + m
            span = old.layout.offsets[j][:, None] + np.arange(d_j)
            values = -(W[d_i][i] @ blocks.values) * before.scale[span][:, None, :]
            put(values, i, column[pair[mine]] + old.offset[j])
        keys, old_keys = self.keys.tolist(), before.keys[source_variable].tolist()
        sizes, old_sizes, begins, firsts = (array.tolist() for array in (self.sizes, width, base, first))
        factors = []
        for variable in np.unique(target_variable).tolist():
            here, size = slice(firsts[variable], firsts[variable + 1]), sizes[variable]
            matrix = flat[begins[variable] : begins[variable + 1]].reshape(-1, size).T
            factors.append(native_factor([keys[variable], *old_keys[here]], [size, *old_sizes[here]], matrix))
        return factors

    def posterior(self, isam: gtsam.ISAM2, x: BlockGaussian, rows: IntArray) -> BlockGaussian:
        """Read the components of the nodes at `rows` from the Bayes tree; the others are those of `x`.

        A component of one variable is a root of the Bayes tree. One of several is too, but GTSAM would eliminate it
        again to hand it over; the sum of its factors is the same information. Raises RuntimeError or LinAlgError where
        the tree has lost its digits.
        """
        components, mean, flat = x.partition, x.mean.copy(), np.array(x.flat)
        blocks, first = unflattened(flat, components), np.unique(components.label[rows], return_index=True)[1]
        for node in rows[first].tolist():
            group, row = components.group[node], components.row[node]
            places = components.groups[group][row]
            variable, order = self.partition.label[node], np.arange(len(places))
            if self.sizes[variable] == len(places):
                conditional = isam.marginalFactor(int(self.keys[variable]))
                R, d = conditional.R(), conditional.d()  # views into what must stay alive
            else:
                order, variables = self._variables_of(places)
                R, d = self._root(isam, variables)
            inverse, singular = scipy.linalg.lapack.dtrtri(R)
            if singular:
                raise np.linalg.LinAlgError("the Bayes tree is singular")
            half = np.empty_like(inverse)
            half[order] = self.scale[places[order], None] * inverse
            mean[places] = self.origin[places] + half @ d
            np.matmul(half, half.T, out=blocks[group][row])
        if not (np.isfinite(mean).all() and np.isfinite(flat).all()):
            raise RuntimeError("the Bayes tree holds numbers that are not finite")
        return BlockGaussian(components, mean, blocks)

    def _root(self, isam: gtsam.ISAM2, variables: IntArray) -> tuple[FloatArray, FloatArray]:
        """R and d of || R x - d || for a component, of variables in this order, from all factors on them."""
        keys, index, factors = self.keys[variables].tolist(), isam.getVariableIndex(), isam.getFactorsUnsafe()
        linear = gtsam.GaussianFactorGraph()
        for i in sorted({i for key in keys for i in index.at(key)}):
            factor = factors.at(i)
            assert isinstance(factor, gtsam.LinearContainerFactor)
            linear.push_back(factor.factor())
        information, vector = linear.hessian(gtsam.Ordering(keys))
        L = np.asarray(np.linalg.cholesky(information), dtype=np.float64)
        return L.T, scipy.linalg.solve_triangular(L, vector, lower=True)

    def _variables_of(self, places: IntArray) -> tuple[IntArray, IntArray]:
        """Order of the entries of a component, at `places` of the joint state, by variable; and its variables."""
        layout = self.partition.layout
        node = np.searchsorted(layout.offsets, places, side="right") - 1
        variable = self.partition.label[node]
        return np.argsort(variable, kind="stable"), np.unique(variable)


def first_nodes(label: IntArray) -> IntArray:
    """A node of each label."""
    return np.unique(label, return_index=True)[1]


def _divided(components: Partition, dynamics: Dynamics | None) -> Partition:
    """Cut large components into parts of nodes that are close in the graph."""
    layout, label = components.layout, components.label
    size = np.bincount(label, weights=layout.dims, minlength=components.count).astype(np.int64)
    if (size <= _WHOLE).all():
        return components
    order = _neighbours_together(layout, dynamics)
    order = order[np.argsort(label[order], kind="stable")]  # component by component
    ends = np.cumsum(layout.dims[order])
    within = np.empty(len(layout), dtype=np.int64)  # where a node's state ends in its component
    within[order] = ends - (np.cumsum(size) - size)[label[order]]
    part = np.where(size[label] > _WHOLE, (within - 1) // _PART, 0)
    return Partition(layout, np.unique(label * (part.max() + 1) + part, return_inverse=True)[1].astype(np.int64))


def _neighbours_together(layout: StateLayout, dynamics: Dynamics | None) -> IntArray:
    """Order the nodes so that those that interact are close (reverse Cuthill-McKee)."""
    if dynamics is None:
        return np.arange(len(layout))
    target = np.concatenate([blocks.target for blocks in dynamics.F])
    source = np.concatenate([blocks.source for blocks in dynamics.F])
    entries = (np.ones(2 * len(target)), (np.concatenate([target, source]), np.concatenate([source, target])))
    graph = scipy.sparse.csr_array(entries, shape=(len(layout), len(layout)))
    return np.asarray(scipy.sparse.csgraph.reverse_cuthill_mckee(graph, symmetric_mode=True), dtype=np.int64)

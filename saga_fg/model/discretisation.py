"""Discretisation of a scene graph: the block-sparse dynamics of an interval, for any dt.

The discrete dynamics of one interval, block-sparse like the graph it came from.

x(t + dt) = F x(t) + b + q,    q ~ N(0, Q),    Q block-diagonal, one block a node

Discretisation of a scene graph: the dynamics of an interval, for any dt.

Node i of the graph obeys, with K_ij the rate of edge j -> i,

    dx_i/dt = M_i x_i + sum_j K_ij A_other x_j + c_i + w_i,   M_i = A_i + sum_j K_ij A_self,   c_i = sum_j K_ij b_ij

Each node is integrated exactly along its own motion and along its own share M_i of all couplings, while its
neighbours move on by their own motion alone (first order in the coupling: the neighbours' neighbours are left out, so
F has the sparsity of the graph):

    F_ii = exp(M_i dt)
    F_ij = int_0^dt exp(M_i (dt - s)) K_ij A_other exp(A_j s) ds
    b_i  = int_0^dt exp(M_i s) ds c_i
    Q_i  = int_0^dt exp(M_i s) Qc exp(M_i^T s) ds

What follows from it:
* one step against two half steps, and against the matrix exponential of the joint generator, differ by O((K dt)^2);
* for shared velocity the gains are w_ij (1 - exp(-K_i dt)): a consensus stays a consensus (row sums are kept) and
  no dt makes the step unstable;
* without edges it is the classical discretisation, exactly.

The integrals are phi functions, phi_0(Z) = exp(Z), phi_{k+1}(Z) = (phi_k(Z) - I/k!) / Z, of Z = M_i dt (Higham,
Functions of Matrices, 2008, section 10.7.4), summed as Taylor series at Z / 2^s and doubled s times. Where exp(A_j s)
is a polynomial in s (constant velocity, constant acceleration), F_ij = sum_k dt^{k+1} phi_{k+1}(Z) K_ij A_other A_j^k;
otherwise F_ij is read off the exponential of the block matrix [[M_i, K_ij A_other], [0, A_j]] (Van Loan 1978).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import scipy.sparse

from saga_fg.errors import InputError
from saga_fg.kernels.matrix_functions import coupling_integrals, phi_and_noise, with_motions
from saga_fg.model.motion import NodeType
from saga_fg.model.scene_graph import Edges, SceneGraph
from saga_fg.numerics import BoolArray, FloatArray, IntArray, unchecked


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
    """Discrete dynamics of the nodes of `graph` over `dt` seconds; made by `discretise`.

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


LONGEST = 1e12  # s; longer than any two timestamps are apart
_TAYLOR_DEGREE = 12
_TAYLOR_RADIUS = 0.5  # (1/2)^13 / 13! = 2e-14 of the leading term


@np.errstate(over="ignore", invalid="ignore")  # ends in an InputError
def discretise(graph: SceneGraph, dt: float) -> Transition:
    """The dynamics of `graph` over `dt` seconds, from 0 to `LONGEST`.

    Raises `InputError` for a dt out of this range, and for one so long that a state, driven apart by its
    interactions, leaves the range of numbers.
    """
    if not 0 <= dt <= LONGEST:
        raise InputError(f"dt: expected a finite number of seconds from 0 to {LONGEST:g}, got {dt!r}")
    if len(graph) == 0:
        return Transition(graph, dt, (), np.empty(0), ())
    kinds, kind = graph.kinds
    coupled = np.zeros(len(graph), dtype=bool)
    for edges in graph.edges:
        coupled[edges.target[edges.rate > 0]] = True
    offsets = np.zeros(len(graph) + 1, dtype=np.int64)
    np.cumsum(graph.dims, out=offsets[1:])
    b = np.zeros(int(offsets[-1]))
    F: list[Blocks] = []
    Q: list[Blocks] = []
    alike: dict[tuple[int, bool], list[int]] = {}  # nodes without incoming edges share their kind's dynamics
    for k in np.bincount(kind[~coupled]).nonzero()[0].tolist():
        alike.setdefault((kinds[k].dim, kinds[k].nilpotency is None), []).append(k)
    for numbers in alike.values():
        place = np.full(len(kinds), -1)
        place[numbers] = np.arange(len(numbers))
        of_row = place[kind]
        rows = (~coupled & (of_row >= 0)).nonzero()[0]
        of_row = of_row[rows]
        own, noise = _own_motions(tuple(kinds[k] for k in numbers), dt)
        F.append(Blocks(rows, rows, own.take(of_row, 0)))
        Q.append(Blocks(rows, rows, noise.take(of_row, 0) * graph.diffusion_scale[rows, None, None]))
    order = max(1, *(t.nilpotency or 0 for t in kinds))
    for d in np.unique(graph.dims[coupled]).tolist():
        rows = (coupled & (graph.dims == d)).nonzero()[0]
        M, Qc, c = _own_dynamics(graph, rows, kinds, kind)
        phi, noise = _phi_and_noise(M, Qc, dt, order)
        F.append(Blocks(rows, rows, phi[0]))
        Q.append(Blocks(rows, rows, noise))
        b[offsets[rows][:, None] + np.arange(d)] = dt * (phi[1] @ c[:, :, None])[..., 0]
        position = np.empty(len(graph), dtype=np.int64)
        position[rows] = np.arange(len(rows))
        for edges in graph.edges:
            if edges.A_other.shape[1] == d and edges.rate.any():
                F.append(_coupling_blocks(edges, dt, M, phi, position, kinds, kind))
    if graph.motions:
        _move_as_recorded(graph, dt, F, b, Q, offsets, coupled)
    made = unchecked(Transition, graph=graph, dt=dt, F=_merged(F, len(graph)), b=b, Q=tuple(Q), offsets=offsets)
    made.check_finite()
    return made


def own_motion(node_type: NodeType, dt: float) -> tuple[FloatArray, FloatArray]:
    """F (d, d) and Q (d, d) of a node without edges over `dt` s."""
    F, Q = _own_motions((node_type,), dt)
    return F[0], Q[0]


@lru_cache(maxsize=64)  # many sensors have one interval, again and again
def _own_motions(types: tuple[NodeType, ...], dt: float) -> tuple[FloatArray, FloatArray]:
    """F and Q (k, d, d), read-only, of nodes of k types, with states of equal size, without edges over `dt` s."""
    generators, diffusions = np.stack([t.generator for t in types]), np.stack([t.diffusion for t in types])
    F, Q = linear_motions(generators, diffusions, dt, _nilpotency(types))
    for array in (F, Q):
        array.flags.writeable = False
    return F, Q


def linear_motions(
    generators: FloatArray, diffusions: FloatArray, dt: float, nilpotency: int | None = None
) -> tuple[FloatArray, FloatArray]:
    """F = exp(A dt) and Q = int_0^dt exp(A s) Qc exp(A s)^T ds of generators A and diffusions Qc, all (m, d, d)."""
    (F,), Q = _phi_and_noise(generators, diffusions, dt, 0, nilpotency)
    return F, Q


def _move_as_recorded(
    graph: SceneGraph,
    dt: float,
    F: list[Blocks],
    b: FloatArray,
    Q: list[Blocks],
    offsets: IntArray,
    coupled: BoolArray,
) -> None:
    """Put the recorded motions in place of those of their types: G_i = F_ii exp(-A_i dt) acts on them, I if alone."""
    own_blocks = [number for number, blocks in enumerate(F) if blocks.target is blocks.source]  # in the order of Q
    for record in graph.motions:
        rows = graph.rows(record.ids)
        if len(rows) == 0:
            continue
        own = record.predicted(dt, graph.diffusion_scale[rows])[1]
        place = np.full(len(graph), -1)
        place[rows] = np.arange(len(rows))
        own_b, back = own.b, _moved_back(graph.types[rows[0]], dt)
        for of_Q, of_F in enumerate(own_blocks):
            target, values = F[of_F].target, F[of_F].values
            if len(target) == 0 or values.shape[1] != own_b.shape[1]:
                continue
            tied = bool(coupled[target[0]])  # and so are all of these blocks
            values, noise, own_b = with_motions(values, Q[of_Q].values, place[target], own.F, own_b, own.Q, back, tied)
            F[of_F], Q[of_Q] = Blocks(target, target, values), Blocks(target, target, noise)
        b[offsets[rows][:, None] + np.arange(own_b.shape[1])] += own_b


@lru_cache(maxsize=64)
def _moved_back(node_type: NodeType, dt: float) -> FloatArray:
    """exp(-A dt) of a type."""
    nothing = np.zeros((1, node_type.dim, node_type.dim))
    return np.asarray(linear_motions(-node_type.generator[None], nothing, dt, node_type.nilpotency)[0][0])


def _own_dynamics(
    graph: SceneGraph, rows: IntArray, kinds: list[NodeType], kind: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """M (m, d, d), Qc (m, d, d), c (m, d) of the nodes `rows`, whose states have equal size."""
    numbers = np.bincount(kind[rows]).nonzero()[0]
    of_row = np.searchsorted(numbers, kind[rows])
    M = np.stack([kinds[k].generator for k in numbers]).take(of_row, 0)
    Qc = np.stack([kinds[k].diffusion for k in numbers]).take(of_row, 0) * graph.diffusion_scale[rows, None, None]
    c = np.zeros(M.shape[:2])
    position = np.full(len(graph), -1)
    position[rows] = np.arange(len(rows))
    for edges in graph.edges:
        if edges.A_self.shape[1] == M.shape[1]:
            acting = (edges.rate > 0).nonzero()[0]
            at, rate = position[edges.target[acting]], edges.rate[acting, None]
            np.add.at(M, at, rate[:, :, None] * edges.A_self[acting])
            np.add.at(c, at, rate * edges.b[acting])
    return M, Qc, c


def _nilpotency(kinds: Sequence[NodeType]) -> int | None:
    """Smallest k with A^k = 0 for all these types, None if there is none."""
    steps = [t.nilpotency for t in kinds]
    return None if None in steps else max(step for step in steps if step is not None)


def _phi_and_noise(
    M: FloatArray, Qc: FloatArray, dt: float, order: int, nilpotency: int | None = None
) -> tuple[FloatArray, FloatArray]:
    """phi_0 ... phi_order of M dt (order + 1, m, d, d), and Q = int_0^dt exp(M s) Qc exp(M^T s) ds.

    Where M^nilpotency = 0 the series end.
    """
    degrees = _TAYLOR_DEGREE, _TAYLOR_DEGREE + 1, _TAYLOR_RADIUS
    if nilpotency is not None:
        degrees = max(nilpotency - 1, 0), max(2 * nilpotency - 1, 1), math.inf
    return phi_and_noise(M, Qc, dt, order, *degrees)


def _coupling_blocks(
    edges: Edges,
    dt: float,
    M: FloatArray,
    phi: FloatArray,
    position: IntArray,
    kinds: list[NodeType],
    kind: IntArray,
) -> Blocks:
    """The off-diagonal blocks F_ij of some edges; M and phi are of the coupled nodes, `position` their rows there."""
    acting = (edges.rate > 0).nonzero()[0]
    target, source = edges.target[acting], edges.source[acting]
    C = edges.rate[acting, None, None] * edges.A_other[acting]
    at = position[target]
    numbers, of_edge = np.unique(kind[source], return_inverse=True)
    A = np.stack([kinds[k].generator for k in numbers.tolist()])
    steps = _nilpotency([kinds[k] for k in numbers.tolist()])
    if steps is None:
        return Blocks(target, source, coupling_integrals(M, at, C, A, of_edge, dt, _TAYLOR_DEGREE, _TAYLOR_RADIUS))
    values = np.zeros_like(C)
    for k in range(steps):
        values += dt ** (k + 1) * (phi[k + 1][at] @ C)
        C = C @ A[of_edge]
    return Blocks(target, source, values)


def _merged(F: list[Blocks], n: int) -> tuple[Blocks, ...]:
    """Blocks of the same shape joined, and those of the same (target, source) pair added up."""
    by_shape: dict[tuple[int, int], list[Blocks]] = {}
    for blocks in F:
        by_shape.setdefault((blocks.values.shape[1], blocks.values.shape[2]), []).append(blocks)
    merged = []
    for same in by_shape.values():
        if len(same) == 1 and same[0].target is same[0].source:
            merged.append(same[0])
            continue
        target = np.concatenate([blocks.target for blocks in same])
        source = np.concatenate([blocks.source for blocks in same])
        values = np.concatenate([blocks.values for blocks in same])
        pairs = target * n + source
        ordered = np.sort(pairs)
        if (ordered[1:] == ordered[:-1]).any():
            pair, first, inverse = np.unique(pairs, return_index=True, return_inverse=True)
            total = np.zeros((len(pair), *values.shape[1:]))
            np.add.at(total, inverse, values)
            target, source, values = target[first], source[first], total
        merged.append(Blocks(target, source, values))
    return tuple(merged)

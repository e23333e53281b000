r"""The joint filter with bounded memory of correlations: exact filters on overlapping pieces of the scene graph.

Correlation between two nodes decays with their distance in the graph. The nodes are divided into clusters of some tens,
each extended by the nodes within h hops of it; every cluster has an exact Kalman filter of its own, and each node is
read from the cluster that owns it, which has all that is near to it. Cost grows as n, not as n^3.

    predict   P_c <- F_c P_c F_c^T + Q_c     nodes outside enter as inputs
    update    that of the exact filter, with all measurements of nodes in the cluster

A node j outside of cluster c comes in from the cluster that owns it: with its mean there, and with F_ij P_jj F_ij^T as
further noise of x_i, independent of everything else,

    x_i <- sum_{j in c} F_ij x_j + sum_{j not in c} F_ij x_j + b_i + q_i          i in c

Each P_c is a sum of congruences of positive definite matrices and stays positive definite: nothing is masked or
tapered. Lost is the correlation with and among nodes outside. If one cluster covers the graph (no
more nodes than `core`, or than `hops`), this is the exact filter.

The log-likelihood is Vecchia's (Estimation and model identification for continuous spatial processes, JRSS B 50, 1988):
the clusters' measurements one after the other, each given those before it as far as they are in the same cluster,

    log p(z) = sum_c log p( z_owned(c) | z_j : j in the halo of c, owned by an earlier cluster )

which is the logarithm of a proper density.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from numpy.typing import ArrayLike

from saga_fg.errors import InputError, require_type
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.correction import Gain, correct, rank
from saga_fg.estimators.dynamics import Dynamics
from saga_fg.estimators.interval_dynamics import IntervalDynamics
from saga_fg.estimators.layout import StateLayout, checked_prior
from saga_fg.estimators.object_factors import prior_graph
from saga_fg.estimators.overlapping_clusters import ClusterBounds, OverlappingClusters, adjacency
from saga_fg.estimators.partition import Partition, regrouped
from saga_fg.estimators.protocol import LatestMarginals, Measurements
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.model.transition import Transition
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class BoundedState:
    """The filter as a value: its clusters, the Gaussian of each, and the time, s."""

    clusters: OverlappingClusters
    x: BlockGaussian
    time: float


class BoundedKalmanFilter(LatestMarginals):
    """The filter that keeps correlations within `hops` of clusters of about `core` nodes.

    A node whose distance grows beyond `hops` is kept for `patience` further predictions, so that edges which come
    and go cost no correlation. See `saga_fg.estimators.protocol.Estimator` for the methods.
    """

    def __init__(self, hops: int = 2, core: int = 16, patience: int = 2) -> None:
        for name, value, least in (("hops", hops, 1), ("core", core, 1), ("patience", patience, 0)):
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise InputError(f"{name}: expected a whole number >= {least}, got {value!r}")
        self._bounds = ClusterBounds(hops, core, patience)
        self._clusters = OverlappingClusters.empty()
        self._state = BlockGaussian.empty()
        self._time = 0.0

    @property
    def nodes(self) -> IntArray:
        return self._clusters.layout.nodes

    @property
    def time(self) -> float:
        return self._time

    @property
    def clusters(self) -> tuple[tuple[int, ...], ...]:
        """The ids of the nodes of each cluster, with its halo."""
        ends = np.cumsum(np.bincount(self._clusters.cluster))[:-1]
        return tuple(tuple(ids.tolist()) for ids in np.split(self.nodes[self._clusters.node], ends) if len(ids))

    def add(self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike) -> None:
        mean, covariance = checked_prior(nodes, means, covariances)
        layout = self._clusters.layout.extended(nodes, mean.shape[1])
        clusters, source = self._clusters.extended(layout)
        state = gathered(self._state, clusters.partition, source)
        new = np.flatnonzero(source < 0)
        new = new[np.argsort(clusters.node[new])]
        if len(new):
            partition = clusters.partition
            state.mean[partition.layout.spans(new)] = mean
            state.blocks[partition.group[new[0]]][partition.row[new]] = covariance
        self._clusters, self._state = clusters, state

    def predict(self, transition: Transition) -> None:
        layout = self._clusters.layout
        dynamics = IntervalDynamics(transition).linearised(layout, self.joint_mean(layout.nodes))
        F = dynamics.matrix.copy()
        F.eliminate_zeros()
        acting = [blocks.values.any(axis=(1, 2)) for blocks in dynamics.F]
        target = [blocks.target[mask] for blocks, mask in zip(dynamics.F, acting, strict=True)]
        source = [blocks.source[mask] for blocks, mask in zip(dynamics.F, acting, strict=True)]
        if target:
            graph = adjacency(len(self.nodes), np.concatenate(target), np.concatenate(source))
            clusters, origin = self._clusters.updated(graph, self._bounds)
            state = gathered(self._state, clusters.partition, origin)
            state = propagated(state, clusters, dynamics, F)
            self._clusters, self._state = clusters, state
        self._time += transition.dt

    def update(self, measurements: Measurements) -> float:
        require_type("measurements", measurements, Measurements)
        if len(measurements) == 0:
            return 0.0
        clusters, m = self._clusters, measurements
        rows = clusters.layout.rows(m.nodes)
        size, d = clusters.layout.spans(rows).shape[1], m.H.shape[2]
        if size != d:
            raise InputError(f"H: expected {size} columns, the size of the nodes' states, got {d}")
        which, copies = clusters.copies(rows)
        # in every cluster: nodes that earlier clusters own, its own, nodes of later clusters
        turn = np.sign(clusters.owner[rows[which]] - clusters.cluster[copies])
        order = np.lexsort((which, turn, clusters.cluster[copies]))
        which, copies, turn = which[order], copies[order], turn[order]
        state, gains, _ = correct(self._state, copies, m.z[which], m.H[which], m.R[which])
        self._state = state
        numbers = clusters.partition.group[copies]
        log_likelihood = -0.5 * m.z.size * math.log(2 * math.pi)
        for number, gain in zip(np.unique(numbers), gains, strict=True):
            mine = numbers == number
            log_likelihood += _conditional(gain, clusters.cluster[copies[mine]], turn[mine] == 0)
        return log_likelihood

    def marginalise(self, nodes: ArrayLike) -> None:
        rows = self._clusters.layout.rows(nodes)
        if len(rows):
            clusters, source = self._clusters.without(rows)
            self._clusters, self._state = clusters, gathered(self._state, clusters.partition, source)

    def joint_covariance(self, nodes: ArrayLike) -> FloatArray:
        """Joint covariance of some nodes, in the order given, of any sizes; always positive definite.

        It is taken from the cluster that has most of them, for the rest from the one that has most of these, and so on;
        between nodes from different clusters it is zero. Its diagonal blocks are those of `covariance`.
        """
        clusters = self._clusters
        rows = clusters.layout.rows(nodes)
        distinct, inverse = np.unique(rows, return_inverse=True)
        chosen, label = self._joint_copies(distinct)
        joint = gathered(self._state, _single(clusters.layout.dims[distinct], label), chosen)
        scaled = self._rescaled(joint, distinct, chosen)
        return scaled.joint(inverse)

    def graph(self) -> SceneFactorGraph:
        """One joint prior for the nodes that each cluster owns, which is all that the filter keeps of the past."""
        clusters = self._clusters
        label = np.unique(clusters.owner, return_inverse=True)[1].astype(np.int64)
        return prior_graph(gathered(self._state, Partition(clusters.layout, label), clusters.owned_copy), self._time)

    def snapshot(self) -> BoundedState:
        """The whole state, as a value."""
        return BoundedState(self._clusters, self._state, self._time)

    def restore(self, state: BoundedState) -> None:
        """Continue from a snapshot, bit-identically."""
        require_type("state", state, BoundedState)
        self._clusters, self._state, self._time = state.clusters, state.x, state.time

    def _at(self, nodes: ArrayLike) -> tuple[BlockGaussian, IntArray]:
        return self._state, self._clusters.owned_copy[self._clusters.layout.rows(nodes)]

    def _joint_copies(self, rows: IntArray) -> tuple[IntArray, IntArray]:
        """The copies that the joint covariance of distinct node rows is made of, and the cluster of each."""
        clusters = self._clusters
        chosen = np.full(len(rows), -1)
        waiting = np.arange(len(rows))
        while len(waiting):
            which, copies = clusters.copies(rows[waiting])
            cluster = int(np.argmax(np.bincount(clusters.cluster[copies])))
            there = clusters.cluster[copies] == cluster
            chosen[waiting[which[there]]] = copies[there]
            waiting = waiting[chosen[waiting] < 0]
        return chosen, clusters.cluster[chosen]

    def _rescaled(self, joint: BlockGaussian, rows: IntArray, chosen: IntArray) -> BlockGaussian:
        """Replace every diagonal block P_ii by that of the owning cluster, by the congruence with L_owner L_ii^-1."""
        own = self._clusters.owned_copy[rows]
        away = np.flatnonzero(own != chosen)
        if len(away) == 0:
            return joint
        layout, partition = joint.layout, joint.partition
        blocks = [block.copy() for block in joint.blocks]
        for d in np.unique(layout.dims[away]).tolist():
            some = away[layout.dims[away] == d]
            try:
                roots = np.linalg.cholesky(self._state.covariances(own[some]))
                inverses = np.linalg.inv(np.linalg.cholesky(joint.covariances(some)))
            except np.linalg.LinAlgError:
                raise InputError("joint covariance: that of a node has lost all digits") from None
            for row, scale in zip(some.tolist(), roots @ inverses, strict=True):
                block = blocks[partition.group[row]][partition.row[row]]
                at = slice(int(partition.offset[row]), int(partition.offset[row]) + d)
                block[at] = scale @ block[at]
                block[:, at] = block[:, at] @ scale.T
        return BlockGaussian(partition, joint.mean, tuple(blocks))


def _conditional(gain: Gain, cluster: IntArray, owned: BoolArray) -> float:
    """Log-density, but for its constant, of the measurements `owned` (m,) given those before them in their cluster."""
    _, component = np.unique(cluster, return_inverse=True)
    slot = rank(cluster)
    k = gain.whitened.shape[1] // (int(slot.max()) + 1)
    at = slot[owned][:, None] * k + np.arange(k)
    row = component[owned][:, None]
    return -0.5 * float((gain.whitened[row, at] ** 2).sum()) - float(np.log(gain.L[row, at, at]).sum())


def _single(dims: IntArray, label: IntArray) -> Partition:
    """A partition of nodes of these sizes by any labels."""
    return Partition(StateLayout(np.arange(len(dims)), dims), np.unique(label, return_inverse=True)[1].astype(np.int64))


def gathered(x: BlockGaussian, partition: Partition, source: IntArray) -> BlockGaussian:
    """Copies of nodes of x, copy k of row source[k], 0 for -1; correlated within components, as the originals."""
    mean, new = np.zeros(partition.layout.size), np.flatnonzero(source >= 0)
    mean[partition.layout.places(new)] = x.mean[x.layout.places(source[new])]
    return BlockGaussian(partition, mean, regrouped(x.blocks, x.partition, partition, source))


def propagated(
    x: BlockGaussian, clusters: OverlappingClusters, dynamics: Dynamics, F: scipy.sparse.csr_array
) -> BlockGaussian:
    """The prior after the interval. F (D, D): the matrix of `dynamics`. Raises `InputError` where it is not finite."""
    partition, layout = clusters.partition, clusters.layout
    states = layout.places(clusters.node)
    rows = F[states]
    node_of = np.repeat(np.arange(len(layout)), layout.dims)
    target = np.repeat(np.repeat(np.arange(len(clusters.node)), layout.dims[clusters.node]), np.diff(rows.indptr))
    node = node_of[rows.indices]
    within = rows.indices - layout.offsets[node]
    source = clusters.find(clusters.cluster[target], node)
    outside = np.flatnonzero(source < 0)
    source[outside] = clusters.owned_copy[node[outside]]
    columns = partition.layout.offsets[source] + within
    size = partition.layout.size
    inner = scipy.sparse.csr_array((rows.data, columns, rows.indptr), shape=(size, size))
    mean = np.asarray(inner @ x.mean + dynamics.b[states])
    noise = _noise(clusters, dynamics)
    if len(outside):
        row = np.repeat(np.arange(size), np.diff(rows.indptr))[outside] - partition.layout.offsets[target[outside]]
        _add_outer(noise, x, clusters, target[outside], node[outside], row, within[outside], rows.data[outside])
        inner.data[outside] = 0.0
        inner.eliminate_zeros()
    blocks = []
    for places, P in zip(partition.groups, x.blocks, strict=True):
        first, last = int(places[0, 0]), int(places[-1, -1]) + 1
        own = inner[first:last, first:last]
        half = (own @ P.reshape(last - first, -1)).reshape(P.shape)
        whole = (own @ np.swapaxes(half, 1, 2).reshape(last - first, -1)).reshape(P.shape)
        whole = whole + np.swapaxes(whole, 1, 2)
        whole /= 2
        blocks.append(whole)
    for d in np.unique(layout.dims).tolist():
        copies = np.flatnonzero(partition.layout.dims == d)
        for number, members, at in partition.members(copies, d):
            row = partition.row[copies[members]]
            blocks[number][row[:, None, None], at[:, :, None], at[:, None, :]] += noise[copies[members], :d, :d]
    if not (np.isfinite(mean).all() and all(np.isfinite(block).all() for block in blocks)):
        raise InputError("transition: the prediction is not finite, the dynamics grow beyond all numbers")
    return BlockGaussian(partition, mean, tuple(blocks))


def _noise(clusters: OverlappingClusters, dynamics: Dynamics) -> FloatArray:
    """Q of every copy, (M, d, d) with the largest d."""
    d = int(clusters.layout.dims.max(initial=0))
    Q = np.zeros((len(clusters.layout), d, d))
    for blocks in dynamics.Q:
        k = blocks.values.shape[1]
        Q[blocks.target, :k, :k] += blocks.values
    return np.asarray(Q[clusters.node])


def _add_outer(
    noise: FloatArray,
    x: BlockGaussian,
    clusters: OverlappingClusters,
    target: IntArray,
    node: IntArray,
    row: IntArray,
    column: IntArray,
    values: FloatArray,
) -> None:
    """Add F_ij P_jj F_ij^T to the noise of copies `target`; entries [row, column] of F_ij for nodes j outside."""
    n, d = len(clusters.layout), noise.shape[1]
    pair, which = np.unique(target * n + node, return_inverse=True)
    F = np.zeros((len(pair), d, d))
    F[which, row, column] = values
    outer = pair % n
    P = np.zeros((len(pair), d, d))
    for k in np.unique(clusters.layout.dims[outer]).tolist():
        same = np.flatnonzero(clusters.layout.dims[outer] == k)
        P[same, :k, :k] = x.covariances(clusters.owned_copy[outer[same]])
    np.add.at(noise, pair // n, F @ P @ np.swapaxes(F, 1, 2))

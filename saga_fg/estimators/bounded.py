r"""The joint filter with bounded memory of correlations: exact filters on overlapping pieces of the scene graph.

Correlation between two nodes decays with their distance in the graph. The nodes are divided into clusters of some tens,
each extended by the nodes within h hops of it; every cluster has an exact Kalman filter of its own, and each node is
read from the cluster in which it is at home, where all that is near to it is known. Cost grows as n, not as n^3.

    predict   P_c <- F_c P_c F_c^T + Q_c     nodes outside enter as inputs (see `saga_fg.estimators.overlapping`)
    update    that of the exact filter, with all measurements of nodes in the cluster

Every P_c is positive definite by construction: nothing is ever masked or tapered. If one cluster covers the graph (no
more nodes than `core`, or than `hops`), this is the exact filter.

The log-likelihood is Vecchia's (Estimation and model identification for continuous spatial processes, JRSS B 50, 1988):
the clusters' measurements one after the other, each given those before it as far as they are in the same cluster,

    log p(z) = sum_c log p( z_home(c) | z_j : j a guest in c, at home in an earlier cluster )

which is the logarithm of a proper density.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.correction import Gain, correct, rank
from saga_fg.estimators.cover import Bounds, Cover
from saga_fg.estimators.factor_graph import prior_graph
from saga_fg.estimators.graph_parts import adjacency
from saga_fg.estimators.layout import Layout, checked_prior
from saga_fg.estimators.motion import Motion
from saga_fg.estimators.newest import NewestMarginals
from saga_fg.estimators.overlapping import gathered, propagated
from saga_fg.estimators.partition import Partition
from saga_fg.estimators.protocol import Measurements, require_kind
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.model.transition import Transition
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class BoundedState:
    """The filter as a value: its clusters, the Gaussian of each, and the time, s."""

    cover: Cover
    x: BlockGaussian
    time: float


class BoundedKalmanFilter(NewestMarginals):
    """The filter that keeps correlations within `hops` of clusters of about `core` nodes.

    A node whose distance grows beyond `hops` is kept for `patience` further predictions, so that edges which come
    and go cost no correlation. See `saga_fg.estimators.protocol.Estimator` for the methods.
    """

    def __init__(self, hops: int = 2, core: int = 16, patience: int = 2) -> None:
        for name, value, least in (("hops", hops, 1), ("core", core, 1), ("patience", patience, 0)):
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise InputError(f"{name}: expected a whole number >= {least}, got {value!r}")
        self._bounds = Bounds(hops, core, patience)
        self._cover = Cover.empty()
        self._state = BlockGaussian.empty()
        self._time = 0.0

    @property
    def nodes(self) -> IntArray:
        return self._cover.layout.nodes

    @property
    def time(self) -> float:
        return self._time

    @property
    def clusters(self) -> tuple[tuple[int, ...], ...]:
        """The ids of the nodes of each cluster, guests included."""
        ends = np.cumsum(np.bincount(self._cover.cluster))[:-1]
        return tuple(tuple(ids.tolist()) for ids in np.split(self.nodes[self._cover.node], ends) if len(ids))

    def add(self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike) -> None:
        mean, covariance = checked_prior(nodes, means, covariances)
        layout = self._cover.layout.extended(nodes, mean.shape[1])
        cover, source = self._cover.extended(layout)
        state = gathered(self._state, cover.partition, source)
        new = np.flatnonzero(source < 0)
        new = new[np.argsort(cover.node[new])]
        if len(new):
            partition = cover.partition
            state.mean[partition.layout.spans(new)] = mean
            state.blocks[partition.group[new[0]]][partition.row[new]] = covariance
        self._cover, self._state = cover, state

    def predict(self, transition: Transition) -> None:
        layout = self._cover.layout
        dynamics = Motion(transition).dynamics(layout, self.joint_mean(layout.nodes))
        F = dynamics.matrix.copy()
        F.eliminate_zeros()
        acting = [blocks.values.any(axis=(1, 2)) for blocks in dynamics.F]
        target = [blocks.target[mask] for blocks, mask in zip(dynamics.F, acting, strict=True)]
        source = [blocks.source[mask] for blocks, mask in zip(dynamics.F, acting, strict=True)]
        if target:
            graph = adjacency(len(self.nodes), np.concatenate(target), np.concatenate(source))
            cover, origin = self._cover.renewed(graph, self._bounds)
            state = gathered(self._state, cover.partition, origin)
            state = propagated(state, cover, dynamics, F)
            self._cover, self._state = cover, state
        self._time += transition.dt

    def update(self, measurements: Measurements) -> float:
        require_kind("measurements", measurements, Measurements)
        if len(measurements) == 0:
            return 0.0
        cover, m = self._cover, measurements
        rows = cover.layout.rows(m.nodes)
        size, d = cover.layout.spans(rows).shape[1], m.H.shape[2]
        if size != d:
            raise InputError(f"H: expected {size} columns, the size of the nodes' states, got {d}")
        which, copies = cover.copies(rows)
        # in every cluster: guests of earlier clusters, nodes at home, guests of later clusters
        turn = np.sign(cover.home[rows[which]] - cover.cluster[copies])
        order = np.lexsort((which, turn, cover.cluster[copies]))
        which, copies, turn = which[order], copies[order], turn[order]
        state, gains, _ = correct(self._state, copies, m.z[which], m.H[which], m.R[which])
        self._state = state
        numbers = cover.partition.group[copies]
        log_likelihood = -0.5 * m.z.size * math.log(2 * math.pi)
        for number, gain in zip(np.unique(numbers), gains, strict=True):
            mine = numbers == number
            log_likelihood += _conditional(gain, cover.cluster[copies[mine]], turn[mine] == 0)
        return log_likelihood

    def marginalise(self, nodes: ArrayLike) -> None:
        rows = self._cover.layout.rows(nodes)
        if len(rows):
            cover, source = self._cover.without(rows)
            self._cover, self._state = cover, gathered(self._state, cover.partition, source)

    def joint_covariance(self, nodes: ArrayLike) -> FloatArray:
        """Joint covariance of some nodes, in the order given, of any sizes; always positive definite.

        Taken from the cluster that has most of them, of the rest from the one that has most of these, and so on;
        between nodes from different clusters it is zero. Its diagonal blocks are those of `covariance`.
        """
        cover = self._cover
        rows = cover.layout.rows(nodes)
        distinct, inverse = np.unique(rows, return_inverse=True)
        chosen, label = self._joint_copies(distinct)
        joint = gathered(self._state, _single(cover.layout.dims[distinct], label), chosen)
        scaled = self._rescaled(joint, distinct, chosen)
        return scaled.joint(inverse)

    def graph(self) -> SceneFactorGraph:
        """One joint prior for the nodes at home in each cluster: the filter keeps nothing of the past but this."""
        cover = self._cover
        label = np.unique(cover.home, return_inverse=True)[1].astype(np.int64)
        return prior_graph(gathered(self._state, Partition(cover.layout, label), cover.own), self._time)

    def snapshot(self) -> BoundedState:
        """The whole state, as a value."""
        return BoundedState(self._cover, self._state, self._time)

    def restore(self, state: BoundedState) -> None:
        """Continue from a snapshot, bit-identically."""
        require_kind("state", state, BoundedState)
        self._cover, self._state, self._time = state.cover, state.x, state.time

    def _at(self, nodes: ArrayLike) -> tuple[BlockGaussian, IntArray]:
        return self._state, self._cover.own[self._cover.layout.rows(nodes)]

    def _joint_copies(self, rows: IntArray) -> tuple[IntArray, IntArray]:
        """The copies that the joint covariance of distinct node rows is made of, and the cluster of each."""
        cover = self._cover
        chosen = np.full(len(rows), -1)
        waiting = np.arange(len(rows))
        while len(waiting):
            which, copies = cover.copies(rows[waiting])
            cluster = int(np.argmax(np.bincount(cover.cluster[copies])))
            there = cover.cluster[copies] == cluster
            chosen[waiting[which[there]]] = copies[there]
            waiting = waiting[chosen[waiting] < 0]
        return chosen, cover.cluster[chosen]

    def _rescaled(self, joint: BlockGaussian, rows: IntArray, chosen: IntArray) -> BlockGaussian:
        """With every diagonal block P_ii made that of the node's home, by the congruence with L_home L_ii^-1."""
        own = self._cover.own[rows]
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


def _conditional(gain: Gain, cluster: IntArray, home: BoolArray) -> float:
    """Log-density, but for its constant, of the measurements `home` (m,) given those before them in their cluster."""
    _, component = np.unique(cluster, return_inverse=True)
    slot = rank(cluster)
    k = gain.whitened.shape[1] // (int(slot.max()) + 1)
    at = slot[home][:, None] * k + np.arange(k)
    row = component[home][:, None]
    return -0.5 * float((gain.whitened[row, at] ** 2).sum()) - float(np.log(gain.L[row, at, at]).sum())


def _single(dims: IntArray, label: IntArray) -> Partition:
    """A partition of nodes of these sizes by any labels."""
    return Partition(Layout(np.arange(len(dims)), dims), np.unique(label, return_inverse=True)[1].astype(np.int64))

"""Overlapping clusters that cover a graph: every node is owned by one cluster and is in the halo of clusters nearby.

    cluster c = { nodes that c owns }  +  halo { nodes within h hops of them }

A node has a copy in every cluster of which it is a member. Clusters follow the graph from step to step: a node enters a
halo as soon as it is within h hops, leaves it after some steps farther away, and is handed over to a cluster of whose
halo it is when that cluster owns more of its neighbours.

Nodes without a cluster are grouped by nested bisection: a connected part that is too large is cut in two along the line
between two nodes far from each other. With a and b the ends of a long shortest path, nodes are ordered by
dist(a, .) - dist(b, .) and cut in the middle (level-structure bisection; George and Liu, Computer Solution of Large
Sparse Positive Definite Systems, 1981, chapter 8).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components, dijkstra

from saga_fg.estimators.layout import StateLayout
from saga_fg.estimators.partition import Partition
from saga_fg.numerics.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class ClusterBounds:
    """Limits of clusters.

    hops: from a node of the halo to the nearest owned one; core: nodes that a new cluster owns; patience: steps that a
    node stays in a halo after it is out of reach
    """

    hops: int
    core: int
    patience: int

    @property
    def most_owned(self) -> int:
        """Number of owned nodes from which a cluster takes over no others."""
        return self.core + self.core // 4


@dataclass(frozen=True, eq=False)
class OverlappingClusters:
    """layout of the nodes, and M copies of them.

    owner    (n,) cluster that owns each node; clusters are numbered from 0 by the size of their states
    cluster  (M,) of each copy, ascending
    node     (M,) row of the node that it is a copy of, ascending within a cluster
    stale    (M,) for how many steps the node has been out of reach
    """

    layout: StateLayout
    owner: IntArray
    cluster: IntArray
    node: IntArray
    stale: IntArray

    @staticmethod
    def empty() -> OverlappingClusters:
        none = np.empty(0, dtype=np.int64)
        return OverlappingClusters(StateLayout(), none, none, none, none)

    @cached_property
    def partition(self) -> Partition:
        """The partition of the copies into clusters."""
        return Partition(StateLayout(np.arange(len(self.node)), self.layout.dims[self.node]), self.cluster)

    @cached_property
    def owned_copy(self) -> IntArray:
        """(n,) copy of each node in the cluster that owns it."""
        return self.find(self.owner, np.arange(len(self.layout)))

    @cached_property
    def _key(self) -> IntArray:
        return self.cluster * len(self.layout) + self.node

    def find(self, cluster: IntArray, node: IntArray) -> IntArray:
        """The copy of node row node[k] in cluster[k], -1 where there is none."""
        if len(self._key) == 0:
            return np.full(len(node), -1)
        key = cluster * len(self.layout) + node
        at = np.minimum(np.searchsorted(self._key, key), len(self._key) - 1)
        return np.where(self._key[at] == key, at, -1)

    def copies(self, rows: IntArray) -> tuple[IntArray, IntArray]:
        """All copies of some node rows (m,), which may repeat: which of the m, and the copy; by m, then cluster."""
        order = np.argsort(self.node, kind="stable")
        count = np.bincount(self.node, minlength=len(self.layout))
        start = np.cumsum(count) - count
        which = np.repeat(np.arange(len(rows)), count[rows])
        first = np.repeat(np.cumsum(count[rows]) - count[rows], count[rows])
        return which, order[np.repeat(start[rows], count[rows]) + np.arange(len(which)) - first]

    def extended(self, layout: StateLayout) -> tuple[OverlappingClusters, IntArray]:
        """Add the further nodes of `layout`, each in a cluster of its own; and the old copy of each, -1: new."""
        old, new = len(self.layout), np.arange(len(self.layout), len(layout))
        alone = int(self.owner.max(initial=-1)) + 1 + np.arange(len(new))
        draft = OverlappingClusters(
            layout,
            np.concatenate([self.owner, alone]),
            np.concatenate([self.cluster, alone]),
            np.concatenate([self.node, new]),
            np.concatenate([self.stale, np.zeros(len(new), dtype=np.int64)]),
        )
        source = np.concatenate([np.arange(len(self.node)), np.full(len(layout) - old, -1)])
        return draft._renumbered(source)

    def without(self, rows: IntArray) -> tuple[OverlappingClusters, IntArray]:
        """Remove the nodes at `rows`, and clusters left without owned nodes; returns also the old copy of each."""
        keep = np.ones(len(self.layout), dtype=bool)
        keep[rows] = False
        where = np.cumsum(keep) - 1
        owner = self.owner[keep]
        source = np.flatnonzero(keep[self.node] & np.isin(self.cluster, owner))
        draft = OverlappingClusters(
            self.layout.without(rows), owner, self.cluster[source], where[self.node[source]], self.stale[source]
        )
        return draft._renumbered(source)

    def updated(self, graph: scipy.sparse.csr_array, bounds: ClusterBounds) -> tuple[OverlappingClusters, IntArray]:
        """Return the clusters for another graph (n, n), symmetric, with ones on the diagonal; and the old copy of each.

        A node enters a cluster as a copy of its owned copy; nodes that enter together come from one cluster as far as
        possible. With bounds that cover the graph no two clusters overlap: nodes ever tied are in one.
        """
        n = len(self.layout)
        if n <= max(bounds.hops, bounds.core):
            owner = self._merged_owners(graph)
            key, stale = owner * n + np.arange(n), np.zeros(n, dtype=np.int64)
        else:
            owner = self._reassigned_owners(graph, self._with_singletons_merged(graph, bounds), bounds)
            near = _reach(graph, owner, bounds.hops)
            mine = np.isin(self.cluster, owner)
            seen = np.isin(self._key, near, assume_unique=True)
            lingering = mine & ~seen & (self.stale < bounds.patience)
            key = np.concatenate([near, self._key[lingering]])
            stale = np.concatenate([np.zeros(len(near), dtype=np.int64), self.stale[lingering] + 1])
        order = np.argsort(key, kind="stable")
        draft = OverlappingClusters(self.layout, owner, key[order] // max(n, 1), key[order] % max(n, 1), stale[order])
        return draft._renumbered(self._copied_from(draft))

    def _merged_owners(self, graph: scipy.sparse.csr_array) -> IntArray:
        """Return the owners, with all clusters merged that share a node or are tied by the graph."""
        n, count = len(self.layout), int(self.owner.max(initial=-1)) + 1
        rows, columns = graph.nonzero()
        a = np.concatenate([self.owner[rows], self.cluster])
        b = np.concatenate([self.owner[columns], self.owner[self.node]])
        ties = scipy.sparse.coo_array((np.ones(len(a)), (a, b)), shape=(count, count))
        joint: IntArray = connected_components(ties, directed=False)[1][self.owner]
        first: IntArray = np.full(count, n + count)
        np.minimum.at(first, joint, self.owner)
        return first[joint]

    def _with_singletons_merged(self, graph: scipy.sparse.csr_array, bounds: ClusterBounds) -> IntArray:
        """Return the owners, with clusters of one node merged by parts of the graph."""
        alone = np.bincount(self.cluster)[self.owner] == 1
        nodes = np.flatnonzero(alone)
        if len(nodes) < 2:
            return self.owner
        label = bisected(graph[nodes][:, nodes], bounds.core)
        owner = self.owner.copy()
        _, first = np.unique(label, return_index=True)
        owner[nodes] = self.owner[nodes[first]][label]
        return owner

    def _reassigned_owners(self, graph: scipy.sparse.csr_array, owner: IntArray, bounds: ClusterBounds) -> IntArray:
        """Return the owners, with nodes handed to owners of more of their neighbours, one from and to each cluster."""
        n, count = len(owner), int(owner.max()) + 1
        votes = graph @ scipy.sparse.csr_array((np.ones(n), (np.arange(n), owner)), shape=(n, count))
        node = np.repeat(np.arange(n), np.diff(votes.indptr))
        owns = votes.indices == owner[node]
        own = np.zeros(n)
        own[node[owns]] = votes.data[owns] - 1  # its own
        gain = votes.data - own[node]
        better = np.flatnonzero((gain > 0) & ~owns)
        better = better[self.find(votes.indices[better].astype(np.int64), node[better]) >= 0]
        owner, size = owner.copy(), np.bincount(owner)
        busy = np.zeros(count, dtype=bool)
        for k in better[np.argsort(-gain[better], kind="stable")].tolist():
            there, here = int(votes.indices[k]), int(owner[node[k]])
            if not (busy[there] or busy[here]) and 0 < size[there] < bounds.most_owned:
                owner[node[k]] = there
                busy[[there, here]] = True
        return owner

    def _copied_from(self, new: OverlappingClusters) -> IntArray:
        """For each copy of new clusters, the old copy that it continues."""
        source = self.find(new.cluster, new.node)
        waiting = np.flatnonzero(source < 0)
        while len(waiting):
            # from the cluster that owns most of those that enter, as many of them as it has
            pair, votes = np.unique(
                new.cluster[waiting] * (len(self.node) + 1) + self.owner[new.node[waiting]], return_counts=True
            )
            cluster, donor = np.divmod(pair, len(self.node) + 1)
            order = np.lexsort((-votes, cluster))
            _, first = np.unique(cluster[order], return_index=True)
            chosen = np.empty(int(cluster.max()) + 1, dtype=np.int64)
            chosen[cluster[order[first]]] = donor[order[first]]
            source[waiting] = self.find(chosen[new.cluster[waiting]], new.node[waiting])
            waiting = waiting[source[waiting] < 0]
        return source

    def _renumbered(self, source: IntArray) -> tuple[OverlappingClusters, IntArray]:
        """Renumber the clusters by the sizes of their states; returns `source` in the new order too."""
        if len(self.cluster) == 0:
            return self, source
        present, cluster = np.unique(self.cluster, return_inverse=True)
        size = np.bincount(cluster, weights=self.layout.dims[self.node])
        rank = np.empty(len(present), dtype=np.int64)
        rank[np.argsort(size, kind="stable")] = np.arange(len(present))
        order = np.lexsort((self.node, rank[cluster]))
        owner = rank[np.searchsorted(present, self.owner)]
        return (
            OverlappingClusters(self.layout, owner, rank[cluster][order], self.node[order], self.stale[order]),
            source[order],
        )


def _reach(graph: scipy.sparse.csr_array, owner: IntArray, hops: int) -> IntArray:
    """Keys cluster * n + node, ascending, of all nodes within some hops of a cluster's owned nodes."""
    n = len(owner)
    near = scipy.sparse.csr_array((np.ones(n), (owner, np.arange(n))), shape=(int(owner.max()) + 1, n))
    for _ in range(hops):
        before = near.nnz
        near = near @ graph
        near.data[:] = 1.0
        if near.nnz == before:
            break
    near.sort_indices()
    cluster = np.repeat(np.arange(near.shape[0]), np.diff(near.indptr))
    return np.asarray(cluster * n + near.indices, dtype=np.int64)


def adjacency(count: int, target: IntArray, source: IntArray) -> scipy.sparse.csr_array:
    """(count, count) ones where one node is tied to another in either direction, and on the diagonal."""
    own = np.arange(count)
    rows, columns = np.concatenate([target, source, own]), np.concatenate([source, target, own])
    matrix = scipy.sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    matrix.sum_duplicates()
    matrix.data[:] = 1.0
    return matrix


def bisected(graph: scipy.sparse.csr_array, size: int) -> IntArray:
    """Cut an undirected graph into connected parts of at most `size` nodes; (n,) part of each node, from 0."""
    label = np.empty(graph.shape[0], dtype=np.int64)
    count = 0
    waiting = [np.arange(graph.shape[0])] if graph.shape[0] else []
    while waiting:
        nodes = waiting.pop()
        inner = graph[nodes][:, nodes]
        found, component = connected_components(inner, directed=False)
        if found > 1:
            order = np.argsort(component, kind="stable")
            ends = np.cumsum(np.bincount(component))[:-1]
            pieces = [nodes[piece] for piece in np.split(order, ends)]
            small = [piece for piece in pieces if len(piece) <= size]
            waiting += [piece for piece in pieces if len(piece) > size]
        elif len(nodes) > size:
            small = []
            waiting += _halves(inner, nodes)
        else:
            small = [nodes]
        for piece in small:
            label[piece] = count
            count += 1
    return label


def _halves(graph: scipy.sparse.csr_array, nodes: IntArray) -> list[IntArray]:
    """The two halves of the nodes of a connected graph."""
    start = 0
    for _ in range(2):  # twice, to get to a node far out
        start = int(np.argmax(_hops(graph, start)))
    from_one = _hops(graph, start)
    from_other = _hops(graph, int(np.argmax(from_one)))
    order = np.lexsort((from_one, from_one - from_other))
    middle = len(nodes) // 2
    return [np.sort(nodes[order[:middle]]), np.sort(nodes[order[middle:]])]


def _hops(graph: scipy.sparse.csr_array, start: int) -> FloatArray:
    """(n,) distance of every node from one."""
    hops: FloatArray = dijkstra(graph, directed=False, indices=np.array([start]), unweighted=True)[0]
    return hops

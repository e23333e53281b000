"""Overlapping clusters that cover a graph: each node is at home in one and a guest in those it is near to.

    cluster c = { nodes at home in c }  +  { nodes within h hops of them }

A node has a copy in every cluster it belongs to. Clusters follow the graph from step to step: a node becomes a guest as
soon as it is within h hops, leaves after it has been farther away for some steps, and moves its home to a cluster in
which it is a guest already when more of its neighbours are at home there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from saga_fg.estimators.graph_parts import parts
from saga_fg.estimators.layout import Layout
from saga_fg.estimators.partition import Partition
from saga_fg.numerics.arrays import IntArray


@dataclass(frozen=True)
class Bounds:
    """hops of a guest from the nearest node at home; nodes at home in a new cluster; steps a guest may linger."""

    hops: int
    core: int
    patience: int

    @property
    def most(self) -> int:
        """Nodes at home in a cluster up to which others may move in."""
        return self.core + self.core // 4


@dataclass(frozen=True, eq=False)
class Cover:
    """layout of the nodes, and M copies of them.

    home     (n,) cluster of each node; clusters are numbered from 0 by the size of their states
    cluster  (M,) of each copy, ascending
    node     (M,) row of the node that it is a copy of, ascending within a cluster
    stale    (M,) for how many steps the node has been out of reach
    """

    layout: Layout
    home: IntArray
    cluster: IntArray
    node: IntArray
    stale: IntArray

    @staticmethod
    def empty() -> Cover:
        none = np.empty(0, dtype=np.int64)
        return Cover(Layout(), none, none, none, none)

    @cached_property
    def partition(self) -> Partition:
        """Of the copies, into clusters."""
        return Partition(Layout(np.arange(len(self.node)), self.layout.dims[self.node]), self.cluster)

    @cached_property
    def own(self) -> IntArray:
        """(n,) copy of each node in its home."""
        return self.find(self.home, np.arange(len(self.layout)))

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

    def extended(self, layout: Layout) -> tuple[Cover, IntArray]:
        """With the further nodes of `layout`, each in a cluster of its own; and the old copy of each, -1 for new."""
        old, new = len(self.layout), np.arange(len(self.layout), len(layout))
        alone = int(self.home.max(initial=-1)) + 1 + np.arange(len(new))
        draft = Cover(
            layout,
            np.concatenate([self.home, alone]),
            np.concatenate([self.cluster, alone]),
            np.concatenate([self.node, new]),
            np.concatenate([self.stale, np.zeros(len(new), dtype=np.int64)]),
        )
        source = np.concatenate([np.arange(len(self.node)), np.full(len(layout) - old, -1)])
        return draft._numbered(source)

    def without(self, rows: IntArray) -> tuple[Cover, IntArray]:
        """Without the nodes at `rows`, and without the clusters they leave empty; and the old copy of each."""
        keep = np.ones(len(self.layout), dtype=bool)
        keep[rows] = False
        where = np.cumsum(keep) - 1
        home = self.home[keep]
        source = np.flatnonzero(keep[self.node] & np.isin(self.cluster, home))
        draft = Cover(
            self.layout.without(rows), home, self.cluster[source], where[self.node[source]], self.stale[source]
        )
        return draft._numbered(source)

    def renewed(self, graph: scipy.sparse.csr_array, bounds: Bounds) -> tuple[Cover, IntArray]:
        """The cover for another graph (n, n), symmetric with ones on the diagonal; and the old copy of each copy.

        A node enters a cluster as a copy of the copy in its home; nodes that enter together come from one cluster as
        far as possible. With bounds that cover the graph no two clusters overlap: nodes ever tied are in one.
        """
        n = len(self.layout)
        if n <= max(bounds.hops, bounds.core):
            home = self._joined_home(graph)
            key, stale = home * n + np.arange(n), np.zeros(n, dtype=np.int64)
        else:
            home = self._moved_home(graph, self._grown(graph, bounds), bounds)
            near = _reach(graph, home, bounds.hops)
            mine = np.isin(self.cluster, home)
            seen = np.isin(self._key, near, assume_unique=True)
            lingering = mine & ~seen & (self.stale < bounds.patience)
            key = np.concatenate([near, self._key[lingering]])
            stale = np.concatenate([np.zeros(len(near), dtype=np.int64), self.stale[lingering] + 1])
        order = np.argsort(key, kind="stable")
        draft = Cover(self.layout, home, key[order] // max(n, 1), key[order] % max(n, 1), stale[order])
        return draft._numbered(self._sources(draft))

    def _joined_home(self, graph: scipy.sparse.csr_array) -> IntArray:
        """Homes, with all clusters made one that share a node or are tied by the graph."""
        n, count = len(self.layout), int(self.home.max(initial=-1)) + 1
        rows, columns = graph.nonzero()
        a = np.concatenate([self.home[rows], self.cluster])
        b = np.concatenate([self.home[columns], self.home[self.node]])
        ties = scipy.sparse.coo_array((np.ones(len(a)), (a, b)), shape=(count, count))
        joint: IntArray = connected_components(ties, directed=False)[1][self.home]
        first: IntArray = np.full(count, n + count)
        np.minimum.at(first, joint, self.home)
        return first[joint]

    def _grown(self, graph: scipy.sparse.csr_array, bounds: Bounds) -> IntArray:
        """Homes, with nodes that are all alone taken together by parts of the graph."""
        alone = np.bincount(self.cluster)[self.home] == 1
        nodes = np.flatnonzero(alone)
        if len(nodes) < 2:
            return self.home
        label = parts(graph[nodes][:, nodes], bounds.core)
        home = self.home.copy()
        _, first = np.unique(label, return_index=True)
        home[nodes] = self.home[nodes[first]][label]
        return home

    def _moved_home(self, graph: scipy.sparse.csr_array, home: IntArray, bounds: Bounds) -> IntArray:
        """Homes, with nodes moved where more of their neighbours live, one at a time from and to each cluster."""
        n, count = len(home), int(home.max()) + 1
        votes = graph @ scipy.sparse.csr_array((np.ones(n), (np.arange(n), home)), shape=(n, count))
        node = np.repeat(np.arange(n), np.diff(votes.indptr))
        at_home = votes.indices == home[node]
        own = np.zeros(n)
        own[node[at_home]] = votes.data[at_home] - 1  # its own
        gain = votes.data - own[node]
        better = np.flatnonzero((gain > 0) & ~at_home)
        better = better[self.find(votes.indices[better].astype(np.int64), node[better]) >= 0]
        home, size = home.copy(), np.bincount(home)
        busy = np.zeros(count, dtype=bool)
        for k in better[np.argsort(-gain[better], kind="stable")].tolist():
            there, here = int(votes.indices[k]), int(home[node[k]])
            if not (busy[there] or busy[here]) and 0 < size[there] < bounds.most:
                home[node[k]] = there
                busy[[there, here]] = True
        return home

    def _sources(self, new: Cover) -> IntArray:
        """For each copy of a new cover, the old copy that it continues."""
        source = self.find(new.cluster, new.node)
        waiting = np.flatnonzero(source < 0)
        while len(waiting):
            # from the cluster in which most of those that enter are at home, whichever of them it has
            pair, votes = np.unique(
                new.cluster[waiting] * (len(self.node) + 1) + self.home[new.node[waiting]], return_counts=True
            )
            cluster, donor = np.divmod(pair, len(self.node) + 1)
            order = np.lexsort((-votes, cluster))
            _, first = np.unique(cluster[order], return_index=True)
            chosen = np.empty(int(cluster.max()) + 1, dtype=np.int64)
            chosen[cluster[order[first]]] = donor[order[first]]
            source[waiting] = self.find(chosen[new.cluster[waiting]], new.node[waiting])
            waiting = waiting[source[waiting] < 0]
        return source

    def _numbered(self, source: IntArray) -> tuple[Cover, IntArray]:
        """The same with clusters numbered by the sizes of their states; `source` in the new order."""
        if len(self.cluster) == 0:
            return self, source
        present, cluster = np.unique(self.cluster, return_inverse=True)
        size = np.bincount(cluster, weights=self.layout.dims[self.node])
        rank = np.empty(len(present), dtype=np.int64)
        rank[np.argsort(size, kind="stable")] = np.arange(len(present))
        order = np.lexsort((self.node, rank[cluster]))
        home = rank[np.searchsorted(present, self.home)]
        return (
            Cover(self.layout, home, rank[cluster][order], self.node[order], self.stale[order]),
            source[order],
        )


def _reach(graph: scipy.sparse.csr_array, home: IntArray, hops: int) -> IntArray:
    """Keys cluster * n + node, ascending, of all nodes within some hops of a cluster's nodes at home."""
    n = len(home)
    near = scipy.sparse.csr_array((np.ones(n), (home, np.arange(n))), shape=(int(home.max()) + 1, n))
    for _ in range(hops):
        before = near.nnz
        near = near @ graph
        near.data[:] = 1.0
        if near.nnz == before:
            break
    near.sort_indices()
    cluster = np.repeat(np.arange(near.shape[0]), np.diff(near.indptr))
    return np.asarray(cluster * n + near.indices, dtype=np.int64)

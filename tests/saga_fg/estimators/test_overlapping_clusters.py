"""Clusters that cover a graph: which nodes they own, which are in their halo, and how they follow the graph."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components, shortest_path

from saga_fg.estimators.layout import StateLayout
from saga_fg.estimators.overlapping_clusters import ClusterBounds, OverlappingClusters, adjacency, bisected


def random_adjacency(seed, n, degree=2.0):
    rng = np.random.default_rng(seed)
    pairs = rng.integers(0, n, (2, rng.poisson(degree * n / 2))) if n else np.empty((2, 0), dtype=int)
    return adjacency(n, *pairs)


def grid(width, height):
    """A lattice of width * height nodes."""
    number = np.arange(width * height).reshape(height, width)
    a = np.concatenate([number[:, :-1].ravel(), number[:-1].ravel()])
    b = np.concatenate([number[:, 1:].ravel(), number[1:].ravel()])
    return adjacency(width * height, a, b)


def fresh(n, dim=4):
    return OverlappingClusters.empty().extended(StateLayout(np.arange(n), np.full(n, dim)))[0]


def distances(graph):
    return shortest_path(graph, directed=False, unweighted=True)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 60), st.integers(1, 20), st.floats(0, 4))
def test_parts_are_connected_small_and_not_cut_without_need(seed, n, size, degree):
    graph = random_adjacency(seed, n, degree)
    label = bisected(graph, size)
    assert sorted(set(label.tolist())) == list(range(label.max(initial=-1) + 1))
    whole = connected_components(graph, directed=False)[1]
    for part in range(label.max(initial=-1) + 1):
        nodes = np.flatnonzero(label == part)
        assert len(nodes) <= size
        assert connected_components(graph[nodes][:, nodes], directed=False)[0] == 1
    for component in set(whole.tolist()):
        nodes = np.flatnonzero(whole == component)
        if len(nodes) <= size:
            assert len(set(label[nodes].tolist())) == 1


def test_parts_of_a_lattice_are_compact():
    """About sixteen parts of a lattice of 16 x 16, with not many more nodes within two hops than a square's."""
    graph = grid(16, 16)
    label = bisected(graph, 16)
    far = distances(graph)
    near = [int((far[label == part].min(axis=0) <= 2).sum()) for part in range(label.max() + 1)]
    assert label.max() + 1 <= 20
    assert np.mean(near) <= 48  # those within two hops of a square of 4 x 4


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(6, 60), st.integers(1, 4), st.integers(1, 5), st.integers(0, 3))
def test_a_cover_follows_changing_graphs(seed, n, hops, core, patience):
    """After every step: each node owned once, all within reach in the halo, others for no longer than patience."""
    rng = np.random.default_rng(seed)
    bounds, clusters = ClusterBounds(hops, core, patience), fresh(n)
    for step in range(5):
        if step == 3:
            gone = rng.permutation(n)[: n // 3]
            clusters, source = clusters.without(gone)
            assert (source >= 0).all()
            n = n - len(gone)
        before = clusters
        graph = random_adjacency(seed + step, n, 1.5)
        clusters, source = clusters.updated(graph, bounds)
        assert (clusters.owned_copy >= 0).all()
        assert (before.node[source] == clusters.node).all()
        assert (np.diff(np.bincount(clusters.cluster, weights=clusters.layout.dims[clusters.node])) >= 0).all()
        if n <= max(hops, core):
            assert (np.bincount(clusters.node) == 1).all()
            continue
        far = distances(graph)
        for cluster in range(clusters.cluster.max() + 1):
            owner = np.flatnonzero(clusters.owner == cluster)
            members = clusters.node[clusters.cluster == cluster]
            assert 1 <= len(owner) <= bounds.most_owned
            reach = np.flatnonzero(far[owner].min(axis=0) <= hops)
            assert set(reach.tolist()) <= set(members.tolist())
        assert (clusters.stale <= patience).all()


def test_a_node_out_of_reach_stays_in_the_halo_for_a_while():
    chain = adjacency(8, np.arange(7), np.arange(1, 8))
    cut = adjacency(8, np.array([0, 1, 2, 4, 5, 6]), np.array([1, 2, 3, 5, 6, 7]))
    bounds = ClusterBounds(hops=2, core=4, patience=2)
    clusters, _ = fresh(8).updated(chain, bounds)
    sizes = [np.bincount(clusters.cluster).tolist()]
    for graph in (cut, cut, cut, chain):
        clusters, _ = clusters.updated(graph, bounds)
        sizes.append(np.bincount(clusters.cluster).tolist())
    assert sizes == [[6, 6], [6, 6], [6, 6], [4, 4], [6, 6]]


def test_a_node_is_handed_over_to_the_owner_of_its_neighbours():
    bounds = ClusterBounds(hops=2, core=4, patience=0)
    clusters, _ = fresh(8).updated(adjacency(8, np.arange(7), np.arange(1, 8)), bounds)
    assert len(set(clusters.owner[:4].tolist())) == len(set(clusters.owner[4:].tolist())) == 1
    moved = adjacency(8, np.array([0, 1, 3, 3, 4, 5, 6]), np.array([1, 2, 4, 5, 5, 6, 7]))
    clusters, _ = clusters.updated(moved, bounds)
    assert clusters.owner[3] == clusters.owner[4] != clusters.owner[0]


def test_where_bounds_cover_the_graph_there_is_no_halo():
    clusters, _ = fresh(9).updated(grid(3, 3), ClusterBounds(hops=9, core=1, patience=0))
    assert clusters.cluster.tolist() == [0] * 9
    clusters, source = clusters.updated(
        adjacency(9, np.empty(0, dtype=int), np.empty(0, dtype=int)), ClusterBounds(9, 1, 0)
    )
    assert clusters.cluster.tolist() == [0] * 9, "what was correlated stays so"
    assert source.tolist() == list(range(9))


@pytest.mark.parametrize("dims", [[4, 4, 2, 6, 4, 2]])
def test_clusters_are_numbered_by_the_size_of_their_states(dims):
    clusters, _ = OverlappingClusters.empty().extended(StateLayout(np.arange(6), dims))
    assert clusters.layout.dims[clusters.node].tolist() == sorted(dims)
    assert clusters.owner[clusters.node].tolist() == list(range(6))

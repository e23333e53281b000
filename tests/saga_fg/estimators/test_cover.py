"""Clusters that cover a graph: who is at home, who is a guest, and how they follow the graph."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components, shortest_path

from saga_fg.estimators.cover import Bounds, Cover
from saga_fg.estimators.graph_parts import adjacency, parts
from saga_fg.estimators.layout import Layout


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
    return Cover.empty().extended(Layout(np.arange(n), np.full(n, dim)))[0]


def distances(graph):
    return shortest_path(graph, directed=False, unweighted=True)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 60), st.integers(1, 20), st.floats(0, 4))
def test_parts_are_connected_small_and_not_cut_without_need(seed, n, size, degree):
    graph = random_adjacency(seed, n, degree)
    label = parts(graph, size)
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
    label = parts(graph, 16)
    far = distances(graph)
    near = [int((far[label == part].min(axis=0) <= 2).sum()) for part in range(label.max() + 1)]
    assert label.max() + 1 <= 20
    assert np.mean(near) <= 48  # those within two hops of a square of 4 x 4


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(6, 60), st.integers(1, 4), st.integers(1, 5), st.integers(0, 3))
def test_a_cover_follows_changing_graphs(seed, n, hops, core, patience):
    """After every step: each node at home once, all within reach are guests, others for no longer than patience."""
    rng = np.random.default_rng(seed)
    bounds, cover = Bounds(hops, core, patience), fresh(n)
    for step in range(5):
        if step == 3:
            gone = rng.permutation(n)[: n // 3]
            cover, source = cover.without(gone)
            assert (source >= 0).all()
            n = n - len(gone)
        before = cover
        graph = random_adjacency(seed + step, n, 1.5)
        cover, source = cover.renewed(graph, bounds)
        assert (cover.own >= 0).all()
        assert (before.node[source] == cover.node).all()
        assert (np.diff(np.bincount(cover.cluster, weights=cover.layout.dims[cover.node])) >= 0).all()
        if n <= max(hops, core):
            assert (np.bincount(cover.node) == 1).all()
            continue
        far = distances(graph)
        for cluster in range(cover.cluster.max() + 1):
            home = np.flatnonzero(cover.home == cluster)
            members = cover.node[cover.cluster == cluster]
            assert 1 <= len(home) <= bounds.most
            reach = np.flatnonzero(far[home].min(axis=0) <= hops)
            assert set(reach.tolist()) <= set(members.tolist())
        assert (cover.stale <= patience).all()


def test_a_guest_out_of_reach_lingers_and_leaves():
    chain = adjacency(8, np.arange(7), np.arange(1, 8))
    cut = adjacency(8, np.array([0, 1, 2, 4, 5, 6]), np.array([1, 2, 3, 5, 6, 7]))
    bounds = Bounds(hops=2, core=4, patience=2)
    cover, _ = fresh(8).renewed(chain, bounds)
    sizes = [np.bincount(cover.cluster).tolist()]
    for graph in (cut, cut, cut, chain):
        cover, _ = cover.renewed(graph, bounds)
        sizes.append(np.bincount(cover.cluster).tolist())
    assert sizes == [[6, 6], [6, 6], [6, 6], [4, 4], [6, 6]]


def test_a_node_moves_its_home_to_where_its_neighbours_live():
    bounds = Bounds(hops=2, core=4, patience=0)
    cover, _ = fresh(8).renewed(adjacency(8, np.arange(7), np.arange(1, 8)), bounds)
    assert len(set(cover.home[:4].tolist())) == len(set(cover.home[4:].tolist())) == 1
    moved = adjacency(8, np.array([0, 1, 3, 3, 4, 5, 6]), np.array([1, 2, 4, 5, 5, 6, 7]))
    cover, _ = cover.renewed(moved, bounds)
    assert cover.home[3] == cover.home[4] != cover.home[0]


def test_where_bounds_cover_the_graph_there_are_no_guests():
    cover, _ = fresh(9).renewed(grid(3, 3), Bounds(hops=9, core=1, patience=0))
    assert cover.cluster.tolist() == [0] * 9
    cover, source = cover.renewed(adjacency(9, np.empty(0, dtype=int), np.empty(0, dtype=int)), Bounds(9, 1, 0))
    assert cover.cluster.tolist() == [0] * 9, "what was correlated stays so"
    assert source.tolist() == list(range(9))


@pytest.mark.parametrize("dims", [[4, 4, 2, 6, 4, 2]])
def test_clusters_are_numbered_by_the_size_of_their_states(dims):
    cover, _ = Cover.empty().extended(Layout(np.arange(6), dims))
    assert cover.layout.dims[cover.node].tolist() == sorted(dims)
    assert cover.home[cover.node].tolist() == list(range(6))

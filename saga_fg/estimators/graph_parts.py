"""Parts of a graph that are compact and of about equal size, found from its edges alone.

A connected part that is too large is cut in two along the line between two nodes far from each other: with a and b the
ends of a long shortest path, nodes are ordered by dist(a, .) - dist(b, .) and cut in the middle (level-structure
bisection; George and Liu, Computer Solution of Large Sparse Positive Definite Systems, 1981, chapter 8).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components, dijkstra

from saga_fg.numerics.arrays import FloatArray, IntArray


def adjacency(count: int, target: IntArray, source: IntArray) -> scipy.sparse.csr_array:
    """(count, count) ones where one node is tied to another in either direction, and on the diagonal."""
    own = np.arange(count)
    rows, columns = np.concatenate([target, source, own]), np.concatenate([source, target, own])
    matrix = scipy.sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    matrix.sum_duplicates()
    matrix.data[:] = 1.0
    return matrix


def parts(graph: scipy.sparse.csr_array, size: int) -> IntArray:
    """(n,) part of each node of an undirected graph, numbered from 0: connected ones of at most `size` nodes each."""
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
    for _ in range(2):  # two looks for a node far out
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

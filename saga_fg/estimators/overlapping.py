r"""Local Gaussians over overlapping clusters of nodes, and their prediction.

Every cluster has a Gaussian of its own over its copies of nodes, with a full covariance. Over an interval

    x_i <- sum_{j in c} F_ij x_j + sum_{j not in c} F_ij x_j + b_i + q_i          i in c

where a node j that is not in c comes in from its home: with its mean there, and with F_ij P_jj F_ij^T as further noise
of x_i, independent of everything else. Each covariance is a sum of congruences of positive definite matrices, so
it stays positive definite; what is lost is the correlation with and among nodes outside.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse

from saga_fg.errors import InputError
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.cover import Cover
from saga_fg.estimators.dynamics import Dynamics
from saga_fg.estimators.partition import Partition, zeros
from saga_fg.numerics.arrays import FloatArray, IntArray


def gathered(x: BlockGaussian, partition: Partition, source: IntArray) -> BlockGaussian:
    """Copies of what is in x: copy k of row source[k], zero for -1.

    Copies that share a component of `partition` and come from one component of x keep their correlation; others have
    none.
    """
    mean, blocks = np.zeros(partition.layout.size), zeros(partition)
    new = np.flatnonzero(source >= 0)
    if len(new) == 0:
        return BlockGaussian(partition, mean, blocks)
    old, layout = source[new], partition.layout
    piece = partition.label[new] * x.partition.count + x.partition.label[old]
    order = np.argsort(piece, kind="stable")
    new, old = new[order], old[order]
    mean[layout.places(new)] = x.mean[x.layout.places(old)]
    dims = layout.dims[new]
    within = np.arange(dims.sum()) - np.repeat(np.cumsum(dims) - dims, dims)
    to = np.repeat(partition.offset[new], dims) + within
    origin = np.repeat(x.partition.offset[old], dims) + within
    first = np.flatnonzero(np.diff(piece[order], prepend=-1))
    start = np.concatenate([[0], np.cumsum(dims)])[np.append(first, len(new))].tolist()
    places = zip(
        partition.group[new[first]].tolist(),
        partition.row[new[first]].tolist(),
        x.partition.group[old[first]].tolist(),
        x.partition.row[old[first]].tolist(),
        strict=True,
    )
    for k, (group, row, old_group, old_row) in enumerate(places):
        a, b = to[start[k] : start[k + 1]], origin[start[k] : start[k + 1]]
        blocks[group][row][a[:, None], a] = x.blocks[old_group][old_row].take(b, axis=0).take(b, axis=1)
    return BlockGaussian(partition, mean, blocks)


def propagated(x: BlockGaussian, cover: Cover, dynamics: Dynamics, F: scipy.sparse.csr_array) -> BlockGaussian:
    """The prior after the interval. F (D, D): the matrix of `dynamics`. Raises `InputError` where it is not finite."""
    partition, layout = cover.partition, cover.layout
    states = layout.places(cover.node)
    rows = F[states]
    node_of = np.repeat(np.arange(len(layout)), layout.dims)
    target = np.repeat(np.repeat(np.arange(len(cover.node)), layout.dims[cover.node]), np.diff(rows.indptr))
    node = node_of[rows.indices]
    within = rows.indices - layout.offsets[node]
    source = cover.find(cover.cluster[target], node)
    outside = np.flatnonzero(source < 0)
    source[outside] = cover.own[node[outside]]
    columns = partition.layout.offsets[source] + within
    size = partition.layout.size
    inner = scipy.sparse.csr_array((rows.data, columns, rows.indptr), shape=(size, size))
    mean = np.asarray(inner @ x.mean + dynamics.b[states])
    noise = _noise(x, cover, dynamics)
    if len(outside):
        row = np.repeat(np.arange(size), np.diff(rows.indptr))[outside] - partition.layout.offsets[target[outside]]
        _add_outer(noise, x, cover, target[outside], node[outside], row, within[outside], rows.data[outside])
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


def _noise(x: BlockGaussian, cover: Cover, dynamics: Dynamics) -> FloatArray:
    """Q of every copy, (M, d, d) with the largest d."""
    d = int(cover.layout.dims.max(initial=0))
    Q = np.zeros((len(cover.layout), d, d))
    for blocks in dynamics.Q:
        k = blocks.values.shape[1]
        Q[blocks.target, :k, :k] += blocks.values
    return np.asarray(Q[cover.node])


def _add_outer(
    noise: FloatArray,
    x: BlockGaussian,
    cover: Cover,
    target: IntArray,
    node: IntArray,
    row: IntArray,
    column: IntArray,
    values: FloatArray,
) -> None:
    """Add F_ij P_jj F_ij^T to the noise of copies `target`; entries [row, column] of F_ij for nodes j outside."""
    n, d = len(cover.layout), noise.shape[1]
    pair, which = np.unique(target * n + node, return_inverse=True)
    F = np.zeros((len(pair), d, d))
    F[which, row, column] = values
    outer = pair % n
    P = np.zeros((len(pair), d, d))
    for k in np.unique(cover.layout.dims[outer]).tolist():
        same = np.flatnonzero(cover.layout.dims[outer] == k)
        P[same, :k, :k] = x.covariances(cover.own[outer[same]])
    np.add.at(noise, pair // n, F @ P @ np.swapaxes(F, 1, 2))

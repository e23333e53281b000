"""A covariance that is not smaller than another one: what is reported of nodes whose solution has not settled.

Where the minimum of the graph is not found, the curvature at the point reached says nothing of the error there.
What measurements took from the predicted covariance P_0 is given back in every direction in which P is smaller,

    P + L (I - M)_+ L^T,      P_0 = L L^T,      M = L^-1 P L^-T

where (.)_+ keeps the positive eigenvalues. This is >= P_0 and >= P, positive definite, the smallest such change in
units of P_0, and the same in all units. The correlations with other nodes stay as they are.
"""

from __future__ import annotations

import numpy as np

from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.numerics.arrays import FloatArray, IntArray


def not_smaller(x: BlockGaussian, least: BlockGaussian, nodes: IntArray) -> BlockGaussian:
    """`x` with a joint covariance of some nodes that is, by components, not smaller than theirs in `least`.

    Nodes that `least` does not have stay as they are.
    """
    rows, blocks = x.layout.rows(nodes[np.isin(nodes, least.layout.nodes)]), [block.copy() for block in x.blocks]
    if len(rows) == 0:
        return x
    partition = x.partition
    for label in np.unique(partition.label[rows]).tolist():
        mine = rows[partition.label[rows] == label]
        deficit = missing_covariance(x.joint(mine), least.joint(least.layout.rows(x.layout.nodes[mine])))
        spans = [partition.offset[row] + np.arange(x.layout.dims[row]) for row in mine.tolist()]
        places, block = np.concatenate(spans), blocks[partition.group[mine[0]]][partition.row[mine[0]]]
        block[np.ix_(places, places)] += deficit
    return BlockGaussian(partition, x.mean, tuple(blocks))


def missing_covariance(P: FloatArray, least: FloatArray) -> FloatArray:
    """(d, d) what P (d, d) needs at least to be not smaller than `least` (d, d)."""
    try:
        L = np.linalg.cholesky(least)
    except np.linalg.LinAlgError:  # a direction without variance
        return least
    half = np.linalg.solve(L, P)
    M = np.linalg.solve(L, half.T)
    eigenvalues, V = np.linalg.eigh((M + M.T) / 2)
    root = L @ (V * np.sqrt(np.maximum(1.0 - eigenvalues, 0.0)))
    return np.asarray(root @ root.T)

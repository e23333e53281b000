"""Linear Gaussian factors of any number of variables, native to GTSAM.

    phi(x) = exp( -1/2 || sum_k A_k x_k - b ||_R^2 )

GTSAM keeps it whitened as one block matrix [W A_1 ... W A_n | W b], W R W^T = 1. From Python its `JacobianFactor` takes
three variables at most; a `GaussianConditional` without frontal variables takes any number, and its clone is a plain
`JacobianFactor`. Handing the block matrix over whole costs half of handing it over block by block.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors.errors import FactorError
from factors.validation import (
    FloatArray,
    KeyArray,
    check_distinct,
    checked,
    checked_covariances,
    checked_key_rows,
    checked_keys,
    format_key,
    format_keys,
    whitener,
    whiteners,
)


def gaussian_factor(
    keys: Iterable[int], blocks: Sequence[ArrayLike], rhs: ArrayLike, covariance: ArrayLike | None = None
) -> gtsam.JacobianFactor:
    """Return the factor || sum_k blocks[k] x_k - rhs ||_covariance.

    keys: n distinct keys, in any order; blocks[k]: (m, d_k); rhs: (m,); covariance: (m, m), None for the identity.
    Raises `FactorError` when shapes disagree, a number is not finite, or the covariance is not positive definite.
    """
    distinct = checked_keys("keys", keys)
    b = checked("rhs", rhs, (None,))
    if not distinct or len(blocks) != len(distinct):
        raise FactorError(f"blocks: expected one block per key, got {len(blocks)} for {len(distinct)} keys")
    matrices = [
        checked(f"block of {format_key(key)}", block, (len(b), None))
        for key, block in zip(distinct, blocks, strict=True)
    ]
    dims = [matrix.shape[1] for matrix in matrices]
    if 0 in dims or not len(b):
        raise FactorError("blocks: expected at least one row, and one column per block")
    augmented = np.column_stack([*matrices, b])
    if covariance is not None:
        augmented = whitener("covariance", covariance, len(b)) @ augmented
    return native_factor(distinct, dims, np.asfortranarray(augmented))


@dataclass(frozen=True, eq=False)
class GaussianFactors:
    """n linear factors of one shape, || sum_k A_ik x(rows[i, k]) - b_i ||^2, whitened, as arrays.

    rows: keys (n, k), distinct within a row; dims: of the k variables; augmented (n, sum(dims) + 1, m): each factor's
    [A_i1 ... A_ik | b_i] transposed, so that it is column-major, as GTSAM wants it
    """

    rows: KeyArray
    dims: tuple[int, ...]
    augmented: FloatArray

    @property
    def keys(self) -> list[int]:
        """All keys, with repetitions."""
        return list(self.rows.ravel().tolist())

    def native(
        self, origins: FloatArray | None = None, chosen: Sequence[int] | None = None
    ) -> list[gtsam.JacobianFactor]:
        """Return them as GTSAM's; on increments from `origins` (n, sum(dims)) of their variables; some, if `chosen`."""
        augmented = self.augmented
        if origins is not None:
            augmented = augmented.copy()
            augmented[:, -1] -= (origins[:, None] @ augmented[:, :-1])[:, 0]
        rows, matrices = self.rows.tolist(), augmented.swapaxes(1, 2)
        which = range(len(rows)) if chosen is None else chosen
        return [native_factor(rows[i], self.dims, matrices[i]) for i in which]


def gaussian_factors(
    keys: ArrayLike, blocks: Sequence[ArrayLike], rhs: ArrayLike, covariances: ArrayLike
) -> list[gtsam.JacobianFactor]:
    """Return n factors of the same shape, || sum_k `blocks[k][i]` x(keys[i, k]) - rhs[i] ||_covariances[i], i = 1..n.

    keys: (n, k), distinct within a row; blocks[k]: (n, m, d_k); rhs: (n, m); covariances: (n, m, m) or one (m, m) for
    all. Whitening and checks are done for all at once, which is what makes them cheap. Raises `FactorError`.
    """
    return stacked_gaussian_factors(keys, blocks, rhs, covariances).native()


def stacked_gaussian_factors(
    keys: ArrayLike, blocks: Sequence[ArrayLike], rhs: ArrayLike, covariances: ArrayLike
) -> GaussianFactors:
    """Return the factors of `gaussian_factors` as arrays."""
    b = checked("rhs", rhs, (None, None))
    n, m = b.shape
    names = checked_key_rows("keys", keys, len(blocks))
    check_distinct("keys", names)
    if len(names) != n:
        raise FactorError(f"keys: expected {n} rows, one per factor, got {len(names)}")
    matrices = [checked(f"blocks[{k}]", block, (n, m, None)) for k, block in enumerate(blocks)]
    W = whiteners("covariances", checked_covariances("covariances", covariances, n, m))
    return whitened_factors(names, W, matrices, b)


def whitened_factors(keys: KeyArray, W: FloatArray, blocks: Sequence[FloatArray], rhs: FloatArray) -> GaussianFactors:
    """Return the factors || W[i] (sum_k blocks[k][i] x(keys[i, k]) - rhs[i]) ||^2 of `stacked_gaussian_factors`.

    Unchecked, except for empty blocks: keys distinct within a row, shapes and numbers right.
    """
    dims = tuple(block.shape[2] for block in blocks)
    n, m = rhs.shape
    if n and (m == 0 or 0 in dims):
        raise FactorError("blocks: expected at least one row, and one column per block")
    augmented = np.empty((n, sum(dims) + 1, m))
    column = 0
    for block, dim in zip(blocks, dims, strict=True):
        np.matmul(block.swapaxes(1, 2), W.swapaxes(1, 2), out=augmented[:, column : column + dim])
        column += dim
    np.matmul(W, rhs[:, :, None], out=augmented[:, -1, :, None])
    return GaussianFactors(keys, dims, augmented)


def native_factor(keys: Sequence[int], dims: Sequence[int], augmented: FloatArray) -> gtsam.JacobianFactor:
    """Return the factor of the whitened block matrix [A_1 ... A_n | b], of shape (m, sum(dims) + 1).

    Unchecked, for inner loops: keys distinct, dims positive, entries finite. Column-major matrices are copied fastest.
    """
    matrix = gtsam.VerticalBlockMatrix(dims, augmented, True)
    factor: gtsam.JacobianFactor = gtsam.GaussianConditional(keys, 0, matrix).clone()  # type: ignore[assignment]
    return factor


def gaussian_graph(factors: Iterable[gtsam.GaussianFactor]) -> gtsam.GaussianFactorGraph:
    """Return a graph that shares these factors."""
    graph = gtsam.GaussianFactorGraph()
    for factor in factors:
        graph.push_back(factor)
    return graph


def nonlinear_graph(factors: Iterable[gtsam.GaussianFactor], dims: Mapping[int, int]) -> gtsam.NonlinearFactorGraph:
    """Wrap linear factors on vector variables for nonlinear solvers and iSAM2.

    dims: the dimension of every key. GTSAM's `LinearContainerFactor` without a linearisation point is silently wrong in
    iSAM2, so these get one, at zero: there the factors speak of the variables themselves, not of increments.
    Raises `FactorError` for a key whose dimension is missing or contradicts its factor.
    """
    point = gtsam.Values()
    for key, dim in dims.items():
        point.insert(key, np.zeros(dim))
    return nonlinear_graph_at(factors, point)


def nonlinear_graph_at(factors: Iterable[gtsam.GaussianFactor], point: gtsam.Values) -> gtsam.NonlinearFactorGraph:
    """Wrap linear factors on increments from `point` (as `NonlinearFactorGraph.linearize(point)` gives them).

    The variables may be of any type. Raises `FactorError` for a key that `point` lacks or holds in another dimension.
    """
    linear = gaussian_graph(factors)
    check_dimensions(map(linear.at, range(linear.size())), point.dims())
    return gtsam.LinearContainerFactor.ConvertLinearGraph(linear, point)


def check_dimensions(factors: Iterable[gtsam.GaussianFactor], dims: Mapping[int, int]) -> None:
    """Raise `FactorError` for a factor whose columns are not as many as its variables' dimensions, or unknown."""
    for factor in factors:
        keys = factor.keys()
        try:
            total = sum([dims[key] for key in keys])
        except KeyError as error:
            raise FactorError(f"{format_key(error.args[0])}: expected its dimension to be known") from error
        width = (factor.cols() if isinstance(factor, gtsam.JacobianFactor) else factor.information().shape[0] + 1) - 1
        if total != width:
            raise FactorError(
                f"the factor on {format_keys(keys)} has {width} columns, but these variables have {total} dimensions"
            )

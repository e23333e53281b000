"""Linear interaction of any number of nodes over one time step.

A node's next state is an affine combination of its own state and its neighbours' (Sani et al., SAGA-KF, ICPR 2024):

    x_i(t+dt) = sum_j F_ij x_j(t) + b_i + q_i,    q_i ~ N(0, Q_i)

    phi  =  || x_i(t+dt) - sum_j F_ij x_j(t) - b_i ||_{Q_i}^2      one factor a node and step

The sum runs over the node itself and its neighbours, who may have states of other dimensions. The factors are native
GTSAM Jacobian factors: nothing calls back into Python while a solver runs. A nonlinear one,
x_i(t+dt) = f( x_i(t), [x_j(t)], dt ) + q_i, is a residual of `factors.ResidualFactors`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.gaussian import GaussianFactors, gaussian_factor, whitened_factors
from factors.validation import (
    FactorError,
    checked,
    checked_key_array,
    checked_key_rows,
    checked_keys,
    whiteners,
)


def interaction_factor(
    next_key: int, keys: Iterable[int], F: Sequence[ArrayLike], b: ArrayLike, Q: ArrayLike
) -> gtsam.JacobianFactor:
    """Return the factor || x(next_key) - sum_j F[j] x(keys[j]) - b ||_Q.

    next_key: the node at t+dt; keys: the node itself and its neighbours at t, in any order; F[j]: (d, d_j); b: (d,);
    Q: (d, d), positive definite. Raises `FactorError` on anything else.
    """
    offset = checked("b", b, (None,))
    transitions = [checked("F", block, (len(offset), None)) for block in F]
    return gaussian_factor([next_key, *keys], [np.eye(len(offset)), *(-block for block in transitions)], offset, Q)


def interaction_factors(
    next_keys: ArrayLike, keys: ArrayLike, indptr: ArrayLike, F: ArrayLike, b: ArrayLike, Q: ArrayLike
) -> list[GaussianFactors]:
    """Return the factors of a whole step, one a node, from arrays in block compressed rows.

    Those with equally many neighbours are together. Node i owns the entries indptr[i] to indptr[i+1] of `keys` and `F`:
    keys (nnz,) of the states at t and blocks F (nnz, d, e). next_keys: (n,); indptr: (n+1,); b: (n, d); Q: (n, d, d),
    each positive definite. Nodes of another dimension, or who listen to some, go into a call of their own, or through
    `interaction_factor`. Raises `FactorError`, naming the node, when shapes disagree, a key occurs twice in one factor,
    a number is not finite or a Q is singular.
    """
    nexts = checked_key_array("next_keys", next_keys)
    previous = checked_key_array("keys", keys)
    checked_keys("next_keys", nexts.tolist())
    offsets = checked("b", b, (len(nexts), None))
    d = offsets.shape[1]
    blocks = checked("F", F, (len(previous), d, None))
    starts, degrees = _rows(indptr, len(nexts), len(previous))
    if not len(nexts):
        return []
    W = whiteners("Q", checked("Q", Q, (len(nexts), d, d)))

    stacks, sharpest = [], np.argsort(-np.abs(W).max(axis=(1, 2)), kind="stable")
    for degree in np.unique(degrees).tolist():  # factors of one shape together, the sharpest first
        rows = sharpest[degrees[sharpest] == degree]
        entries = starts[rows, None] + np.arange(degree)
        names = checked_key_rows("keys", np.concatenate([nexts[rows, None], previous[entries]], axis=1), 1 + degree)
        identity = np.broadcast_to(np.eye(d), (len(rows), d, d))
        own = [identity, *(-blocks[column] for column in entries.T)]
        stacks.append(whitened_factors(names, W[rows], own, offsets[rows]))
    return stacks


def _rows(indptr: ArrayLike, nodes: int, entries: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    pointers = np.asarray(indptr)
    if pointers.shape != (nodes + 1,) or pointers.dtype.kind not in "iu":
        raise FactorError(f"indptr: expected {nodes + 1} integers, got shape {pointers.shape}")
    pointers = pointers.astype(np.int64)
    degrees = np.diff(pointers)
    if pointers[0] != 0 or pointers[-1] != entries or (degrees < 0).any():
        raise FactorError(f"indptr: expected to rise from 0 to the number of entries, {entries}")
    return pointers[:-1], degrees

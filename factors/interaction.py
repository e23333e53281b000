"""Interactions of any number of nodes over one time step, linear or from a function.

Linear interaction of any number of nodes over one time step.

A node's next state is an affine combination of its own state and its neighbours' (Sani et al., SAGA-KF, ICPR 2024):

    x_i(t+dt) = sum_j F_ij x_j(t) + b_i + q_i,    q_i ~ N(0, Q_i)

    phi  =  || x_i(t+dt) - sum_j F_ij x_j(t) - b_i ||_{Q_i}^2      one factor a node and step

The sum runs over the node itself and its neighbours, who may have states of other dimensions. The factors are native
GTSAM Jacobian factors: nothing calls back into Python while a solver runs.

Nonlinear interaction of any number of nodes over one time step, from a function.

    x_i(t+dt) = f( x_i(t), [x_j(t)]_{j in N(i)}, dt ) + q_i,    q_i ~ N(0, Q_i)

    phi  =  || x_i(t+dt) - f(x_i(t), [x_j(t)], dt) ||_{Q_i}^2

Whoever has an f has a factor: social repulsion, a coordinated turn, a car-following law. See `NonlinearInteraction`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.gaussian import GaussianFactors, gaussian_factor, whitened_factors
from factors.nonlinear import ResidualFactors
from factors.robust import RobustLoss
from factors.validation import (
    FactorError,
    FloatArray,
    checked,
    checked_covariances,
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


Prediction = Callable[[FloatArray, list[FloatArray], float], ArrayLike]
Derivative = Callable[[FloatArray, list[FloatArray], float], tuple[ArrayLike, Sequence[ArrayLike]]]


@dataclass(frozen=True)
class NonlinearInteraction:
    """An interaction from a function of NumPy arrays.

    predict(x, others, dt) -> (n, d): the states of n nodes dt seconds later, from their states x (n, d) and those of
    their neighbours, a list of arrays (n, d_j), which may be empty. jacobians(x, others, dt) -> (F, [F_j, ...]), of
    shapes (n, d, d) and (n, d, d_j); central differences when absent. angles: components of the state that are angles
    in rad, so that turning past pi is no jump. name: for messages, by default that of `predict`.

        def repel(x, others, dt): ...

        factors = NonlinearInteraction(repel).factors([next_key], [[key, *neighbours]], 4, dt=0.1, covariances=Q)
        factors.linearise(values)  # for our solver, `factors.solver`
        factors.custom_factors()  # for GTSAM's
    """

    predict: Prediction
    jacobians: Derivative | None = None
    angles: tuple[int, ...] = ()
    name: str = ""

    def factors(
        self,
        next_keys: ArrayLike,
        keys: ArrayLike,
        dims: int | Sequence[int],
        dt: float,
        covariances: ArrayLike,
        robust: RobustLoss | None = None,
    ) -> ResidualFactors:
        """Return the factors of n nodes with k neighbours each, evaluated together.

        next_keys: (n,) the nodes at t+dt; keys: (n, 1 + k) the nodes and their neighbours at t; dims: dimension of
        every state, or of the node's followed by each neighbour's; dt: seconds, >= 0; covariances: Q (n, d, d), or
        (d, d) for all. Raises `FactorError`.
        """
        later, now = checked_key_array("next_keys", next_keys), checked_key_array("keys", keys)
        if now.ndim != 2 or len(now) != len(later):
            raise FactorError(f"keys: expected shape ({len(later)}, 1 + k), one row per next key, got {now.shape}")
        rows = np.column_stack([later, now])
        own, *others = [dims] * now.shape[1] if isinstance(dims, int) else dims
        step = float(checked("dt", dt, ()))
        if step < 0:
            raise FactorError(f"dt: expected a duration of at least 0 s, got {step}")
        Q = checked_covariances("covariances", covariances, len(later), own)
        jacobians = None if self.jacobians is None else partial(_jacobians, self.jacobians, step)
        residual, name = partial(_residual, self.predict, step), self.name or getattr(self.predict, "__name__", "")
        return ResidualFactors(
            rows, (own, own, *others), residual, Q, jacobians, robust, self.angles, f"{name} interactions"
        )


def _residual(predict: Prediction, dt: float, later: FloatArray, x: FloatArray, *others: FloatArray) -> FloatArray:
    return later - checked("prediction", predict(x, list(others), dt), x.shape)


def _jacobians(
    jacobians: Derivative, dt: float, later: FloatArray, x: FloatArray, *others: FloatArray
) -> list[FloatArray]:
    F, F_others = jacobians(x, list(others), dt)
    identity = np.broadcast_to(np.eye(later.shape[-1]), (*later.shape, later.shape[-1]))
    return [identity, *(-np.asarray(block, dtype=np.float64) for block in (F, *F_others))]

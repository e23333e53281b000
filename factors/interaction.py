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
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.gaussian import GaussianFactors, gaussian_factor, whitened_factors
from factors.manifolds import Vector, stacked_differences, wrap_angles
from factors.nonlinear import ResidualFactor, ResidualFactors
from factors.robust import RobustLoss
from factors.validation import (
    FactorError,
    FloatArray,
    check_distinct,
    checked,
    checked_covariances,
    checked_key_array,
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
) -> list[gtsam.JacobianFactor]:
    """Return the factors of a whole step, one a node, from arrays in block compressed rows.

    Node i owns the entries indptr[i] to indptr[i+1] of `keys` and `F`: keys (nnz,) of the states at t and blocks
    F (nnz, d, e). next_keys: (n,); indptr: (n+1,); b: (n, d); Q: (n, d, d), each positive definite. Nodes of another
    dimension, or who listen to some, go into a call of their own, or through `interaction_factor`.
    Raises `FactorError`, naming the node, when shapes disagree, a key occurs twice in one factor, a number is not
    finite or a Q is singular.
    """
    stacks = stacked_interaction_factors(next_keys, keys, indptr, F, b, Q)
    made = {int(factor.keys()[0]): factor for stack in stacks for factor in stack.native()}
    return [made[key] for key in checked_key_array("next_keys", next_keys).tolist()]


def stacked_interaction_factors(
    next_keys: ArrayLike, keys: ArrayLike, indptr: ArrayLike, F: ArrayLike, b: ArrayLike, Q: ArrayLike
) -> list[GaussianFactors]:
    """Return the factors of `interaction_factors` as arrays, those with equally many neighbours together."""
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
        names = np.concatenate([nexts[rows, None], previous[entries]], axis=1)
        check_distinct("keys", names)
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

    predict(x, others, dt) -> (d,): the node's state dt seconds later, from its state x (d,) and its neighbours' states
    others, a list of (d_j,), which may be empty. jacobians(x, others, dt) -> (F, [F_j, ...]), of shapes (d, d) and
    (d, d_j); central differences of `predict` when absent. angles: components of the state that are angles in rad, so
    that turning past pi is no jump. name: for messages, by default that of `predict`.

        def repel(x, others, dt): ...

        factor = NonlinearInteraction(repel).factor(next_key, key, neighbours, dims=4, dt=0.1, covariance=Q)
        factor.linearise(values)  # for our solver, `factors.solver`
        graph.add(factor.as_custom_factor())  # for GTSAM's
    """

    predict: Prediction
    jacobians: Derivative | None = None
    angles: tuple[int, ...] = ()
    name: str = ""

    def factor(
        self,
        next_key: int,
        key: int,
        neighbours: Sequence[int],
        dims: int | Sequence[int],
        dt: float,
        covariance: ArrayLike,
        robust: RobustLoss | None = None,
    ) -> ResidualFactor:
        """Return the factor of one node and step.

        next_key, key: the node at t+dt and at t; neighbours: the others at t; dims: dimension of every state, or of
        the node's followed by each neighbour's; dt: seconds, >= 0; covariance: Q (d, d). Raises `FactorError`.
        """
        own, others = _dimensions(dims, len(neighbours))
        step = _checked_step(dt)

        return ResidualFactor(
            keys=(next_key, key, *neighbours),
            variables=(Vector(own), Vector(own), *map(Vector, others)),
            residual=partial(_residual, self, step),
            covariance=checked("covariance", covariance, (own, own)),
            jacobians=partial(_jacobians, self, step),
            robust=robust,
            angles=self.angles,
            name=self._named,
        )

    def factors(
        self,
        next_keys: ArrayLike,
        keys: ArrayLike,
        neighbours: ArrayLike,
        dims: int | Sequence[int],
        dt: float,
        covariances: ArrayLike,
        robust: RobustLoss | None = None,
    ) -> ResidualFactors:
        """Return the factors of n nodes with k neighbours each, evaluated together.

        For that `predict`, and `jacobians` if given, must take stacks as well: x (n, d) and others, k arrays (n, d_j),
        giving (n, d), and Jacobians (n, d, d) and (n, d, d_j). A function that indexes from the end, x[..., 2], does.
        next_keys, keys: (n,); neighbours: (n, k), one column a neighbour; dims: as in `factor`; covariances: (n, d, d),
        or (d, d) for all. Raises `FactorError`.
        """
        later, now = checked_key_array("next_keys", next_keys), checked_key_array("keys", keys)
        near = np.asarray(neighbours)
        if near.ndim != 2 or not len(later) == len(now) == len(near):
            raise FactorError(
                f"neighbours: expected shape (n, k), with n keys and n next_keys, got {near.shape}, "
                f"with {len(now)} and {len(later)}"
            )
        others_keys = [checked_key_array("neighbours", column) for column in near.T]
        own, others = _dimensions(dims, near.shape[1])
        step = _checked_step(dt)
        return ResidualFactors(
            rows=np.stack([later, now, *others_keys], axis=1),
            dims=(own, own, *others),
            residual=partial(_residual, self, step),
            covariances=checked_covariances("covariances", covariances, len(later), own),
            jacobians=partial(_jacobians, self, step),
            robust=robust,
            angles=self.angles,
            name=f"{self._named} interactions",
        )

    @property
    def _named(self) -> str:
        return self.name or str(getattr(self.predict, "__name__", "interaction"))

    def affine(
        self, x: ArrayLike, others: Sequence[ArrayLike], dt: float
    ) -> tuple[FloatArray, list[FloatArray], FloatArray]:
        """Return (F, [F_j, ...], b) with f(y, [y_j, ...], dt) = F y + sum_j F_j y_j + b around x, others.

        First order; that is what linear estimators and `interaction_factor` take. Raises `FactorError`.
        """
        state = checked("x", x, (None,)).copy()
        near = [checked("others", other, (None,)).copy() for other in others]
        for array in (state, *near):
            array.flags.writeable = False
        step = _checked_step(dt)
        F, F_others = self.differentiated(state, near, step)
        b = self.predicted(state, near, step) - F @ state
        for block, other in zip(F_others, near, strict=True):
            b -= block @ other
        return F, F_others, b

    def predicted(self, x: FloatArray, others: list[FloatArray], dt: float) -> FloatArray:
        """Return the checked prediction, of the shape of x."""
        return checked("prediction", self.predict(x, others, dt), x.shape)

    def differentiated(self, x: FloatArray, others: list[FloatArray], dt: float) -> tuple[FloatArray, list[FloatArray]]:
        """Return the checked Jacobians, (..., d, d) and [(..., d, d_j), ...], of the prediction."""
        if self.jacobians is None:
            center = self.predicted(x, others, dt)

            def near(x: FloatArray, *others: FloatArray) -> FloatArray:
                return wrap_angles(self.predicted(x, list(others), dt) - center, self.angles)

            F, *F_others = stacked_differences(near, [x, *others])
            return F, F_others
        own, given = self.jacobians(x, others, dt)
        if len(given) != len(others):
            raise FactorError(f"jacobians: expected one per neighbour, {len(others)}, got {len(given)}")
        return checked("jacobian of x", own, (*x.shape, x.shape[-1])), [
            checked(f"jacobian of neighbour {j}", block, (*x.shape, other.shape[-1]))
            for j, (block, other) in enumerate(zip(given, others, strict=True))
        ]


def _residual(interaction: NonlinearInteraction, dt: float, *states: FloatArray) -> FloatArray:
    later, x, *others = states
    return later - interaction.predicted(x, others, dt)


def _jacobians(interaction: NonlinearInteraction, dt: float, *states: FloatArray) -> list[FloatArray]:
    later, x, *others = states
    F, F_others = interaction.differentiated(x, others, dt)
    identity = np.broadcast_to(np.eye(later.shape[-1]), F.shape)
    return [identity, -F, *(-block for block in F_others)]


def _dimensions(dims: int | Sequence[int], neighbours: int) -> tuple[int, list[int]]:
    own, *others = [dims] * (1 + neighbours) if isinstance(dims, int) else list(dims)
    if len(others) != neighbours:
        raise FactorError(f"dims: expected {1 + neighbours} dimensions, got {1 + len(others)}")
    return own, others


def _checked_step(dt: Any) -> float:
    step = float(checked("dt", dt, ()))
    if step < 0:
        raise FactorError(f"dt: expected a duration of at least 0 s, got {step}")
    return step

"""Many nonlinear factors of one shape, evaluated and linearised together.

    phi_i(x) = exp( -rho( || r_i(x_i1, ..., x_in) ||_{R_i} ) ),      i = 1..N

The same factor as `factors.nonlinear.ResidualFactor`, N times, with one call of the residual function for all: what
costs tens of microseconds a factor in a loop costs a few.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.differences import stacked_differences, wrap_angles
from factors.errors import FactorError
from factors.gaussian import gaussian_graph, whitened_factors
from factors.nonlinear import ResidualFactor
from factors.robust import Mixture, RobustLoss
from factors.validation import (
    FloatArray,
    KeyArray,
    check_distinct,
    checked,
    checked_covariances,
    checked_key_rows,
    format_key,
    format_keys,
    whiteners,
)
from factors.variables import PlanarPose, SpatialPose, Variable, Vector

IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ResidualFactors:
    """N factors from one residual function over stacked states.

    rows: keys (N, n), distinct within a row; dims: of each of the n variables the dimension if it is a vector, or
    `PlanarPose()`, `SpatialPose()`; residual(*states) -> (N, m) from states (N, d_k), poses (N, 3, 3) or (N, 4, 4), in
    the order of the columns; covariances: (N, m, m), or one (m, m) for all; jacobians(*states) -> one (N, m, d_k) a
    column (d_k: of a pose's delta), by central differences when absent, which needs vectors; robust, angles, name: as
    in `ResidualFactor`. Row i of what a function returns must depend on row i of its arguments alone.
    """

    rows: KeyArray
    dims: tuple[int | PlanarPose | SpatialPose, ...]
    residual: Callable[..., ArrayLike]
    covariances: FloatArray
    jacobians: Callable[..., Sequence[ArrayLike]] | None = None
    robust: RobustLoss | None = None
    angles: tuple[int, ...] = ()
    name: str = "factors"
    _whiteners: FloatArray = field(init=False, repr=False)
    _variables: tuple[Variable, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        rows = checked_key_rows("rows", self.rows, len(self.dims))
        check_distinct("rows", rows)
        poses = [isinstance(dim, PlanarPose | SpatialPose) for dim in self.dims]
        if any(poses) and self.jacobians is None:
            raise FactorError("jacobians: expected a function, since there are poses among the variables")
        numbers = [dim for dim, pose in zip(self.dims, poses, strict=True) if not pose]
        if any(isinstance(dim, bool) or not isinstance(dim, int | np.integer) or dim < 1 for dim in numbers):
            raise FactorError(f"dims: expected positive integers or types of poses, got {self.dims}")
        stack = checked_covariances("covariances", self.covariances, len(rows), None).copy()
        if not stack.shape[1]:
            raise FactorError("covariances: expected at least one row")
        W = whiteners("covariances", stack)
        if any(not 0 <= component < W.shape[1] for component in self.angles):
            raise FactorError(f"angles: expected components from 0 to {W.shape[1] - 1}, got {self.angles}")
        object.__setattr__(self, "rows", rows)
        object.__setattr__(self, "dims", tuple(self.dims))
        object.__setattr__(self, "covariances", stack)
        object.__setattr__(self, "_whiteners", W)
        variables = tuple(dim if isinstance(dim, PlanarPose | SpatialPose) else Vector(dim) for dim in self.dims)
        object.__setattr__(self, "_variables", variables)

    def __str__(self) -> str:
        return f"{len(self.rows)} {self.name}"

    @property
    def keys(self) -> tuple[int, ...]:
        """All keys, each once."""
        return tuple(np.unique(self.rows).tolist())

    def individual_factors(self) -> list[ResidualFactor]:
        """Return the same as factors of their own, each of which evaluates the whole stack."""
        return [self.individual_factor(k) for k in range(len(self.rows))]

    def individual_factor(self, k: int) -> ResidualFactor:
        """Return one of them."""
        return ResidualFactor(
            keys=tuple(self.rows[k].tolist()),
            variables=self._variables,
            residual=partial(self._single_residual, k),
            covariance=self.covariances[min(k, len(self.covariances) - 1)],  # one may serve all
            jacobians=partial(self._single_jacobians, k),
            robust=self.robust.of_row(k) if isinstance(self.robust, Mixture) else self.robust,
            angles=self.angles,
            name=self.name,
        )

    def _single_residual(self, k: int, *states: FloatArray) -> FloatArray:
        return np.asarray(self._residuals(self._filled(self._stacks(states), np.array([k])))[k])

    def _single_jacobians(self, k: int, *states: FloatArray) -> list[FloatArray]:
        return [J[k] for J in self._jacobians(self._filled(self._stacks(states), np.array([k])))]

    def _stacks(self, states: Sequence[Any]) -> list[FloatArray]:
        return [variable.array(x)[None] for variable, x in zip(self._variables, states, strict=True)]

    def states(self, values: gtsam.Values, chosen: IntArray | None = None) -> list[FloatArray]:
        """Return the states of each column, (N, d_k) or (N, 3, 3) or (N, 4, 4); of the rows `chosen` (n,) if given."""
        rows = self.rows if chosen is None else self.rows[chosen]
        return [self._column(values, rows[:, k], variable) for k, variable in enumerate(self._variables)]

    def errors(self, values: gtsam.Values, chosen: IntArray | None = None) -> FloatArray:
        """Return the cost rho(|| r_i ||) of each factor, (N,), or of the rows `chosen` (n,)."""
        residuals = self._residuals(self._filled(self.states(values, chosen), chosen))
        distances = self._distances(residuals)
        return _of(0.5 * distances**2 if self.robust is None else self.robust.cost(distances), chosen)

    def error(self, values: gtsam.Values) -> float:
        """Return the cost of all together."""
        return float(self.errors(values).sum())

    def linearise(self, values: gtsam.Values) -> gtsam.GaussianFactorGraph:
        """Return the factors on the increments from `values`, weighted by the robust loss there."""
        W, jacobians, residuals = self.linearisation(values)
        return gaussian_graph(whitened_factors(self.rows, W, jacobians, -residuals).native())

    def linearisation(
        self, values: gtsam.Values, chosen: IntArray | None = None
    ) -> tuple[FloatArray, list[FloatArray], FloatArray]:
        """Return whiteners (N, m, m), weighted by the robust loss, Jacobians, one (N, m, d_k) a column, and residuals
        (N, m), all at `values`; or of the rows `chosen` (n,), whose variables are then the only ones asked for.
        """
        states = self._filled(self.states(values, chosen), chosen)
        residuals = self._residuals(states)
        W = np.broadcast_to(self._whiteners, (len(self.rows), *self._whiteners.shape[1:]))
        if self.robust is not None:
            W = W * np.sqrt(self.robust.weight(self._distances(residuals)))[:, None, None]
        return _of(W, chosen), [_of(J, chosen) for J in self._jacobians(states)], _of(residuals, chosen)

    def _column(self, values: gtsam.Values, keys_of_rows: KeyArray, variable: Variable) -> FloatArray:
        keys, index = np.unique(keys_of_rows, return_inverse=True)
        states = []
        for key in keys.tolist():
            try:
                states.append(variable.array(variable.read(values, key)))
            except RuntimeError as error:
                reason = "another type of variable in" if values.exists(key) else "no"
                raise FactorError(f"{self}: values has {reason} {format_key(key)}") from error
            except FactorError as error:
                raise FactorError(f"{self}: {error}") from error
        shape = (0, variable.dim) if isinstance(variable, Vector) else (0, 1, 1)
        column: FloatArray = np.stack(states)[index] if states else np.empty(shape)
        column.flags.writeable = False
        return column

    def _filled(self, states: Sequence[FloatArray], chosen: IntArray | None) -> list[FloatArray]:
        """States of all rows, the functions' shapes: those that are not chosen stand where the first chosen one is."""
        if chosen is None or not len(chosen):
            return list(states)
        filled = []
        for column in states:
            everywhere = np.repeat(column[:1], len(self.rows), axis=0)
            everywhere[chosen] = column
            everywhere.flags.writeable = False
            filled.append(everywhere)
        return filled

    def _distances(self, residuals: FloatArray) -> FloatArray:
        whitened = (self._whiteners @ residuals[:, :, None])[:, :, 0]
        return np.asarray(np.linalg.norm(whitened, axis=1))

    def _residuals(self, states: Sequence[FloatArray]) -> FloatArray:
        shape = (len(self.rows), self._whiteners.shape[1])
        return wrap_angles(self._checked("residual", self._called(self.residual, states), shape), self.angles)

    def _jacobians(self, states: Sequence[FloatArray]) -> list[FloatArray]:
        n, m = len(self.rows), self._whiteners.shape[1]
        if self.jacobians is None:
            center = self._residuals(states)
            return stacked_differences(lambda *moved: wrap_angles(self._residuals(moved) - center, self.angles), states)
        given = self._called(self.jacobians, states)
        if not isinstance(given, list | tuple) or len(given) != len(self.dims):
            raise FactorError(f"{self}: expected a list of {len(self.dims)} Jacobians, one per variable")
        return [
            self._checked(f"Jacobian {k}", jacobian, (n, m, variable.dim))
            for k, (jacobian, variable) in enumerate(zip(given, self._variables, strict=True))
        ]

    def _called(self, function: Callable[..., Any], states: Sequence[FloatArray]) -> Any:
        try:
            return function(*states)
        except Exception as error:
            raise FactorError(f"{self}: {error if isinstance(error, FactorError) else repr(error)}") from error

    def _checked(self, name: str, value: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
        try:
            return checked(name, value, shape)
        except FactorError as error:
            raise FactorError(f"{self} on {format_keys(self.rows[:, 0])}: {error}") from error


def _of(array: FloatArray, chosen: IntArray | None) -> FloatArray:
    return array if chosen is None else array[chosen]


def residual_factors(
    function: Any,
    rows: ArrayLike,
    dims: Sequence[int | PlanarPose | SpatialPose],
    covariances: ArrayLike,
    dim: int,
    name: str,
    robust: RobustLoss | None = None,
    angles: Sequence[int] = (),
) -> ResidualFactors:
    """Return the factors of an object with `residual` and `jacobians`; dim: m, of the residuals; the rest as there."""
    keys = np.asarray(rows)
    noise = checked_covariances("covariances", covariances, len(keys), dim)
    return ResidualFactors(keys, tuple(dims), function.residual, noise, function.jacobians, robust, tuple(angles), name)

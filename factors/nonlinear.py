"""Nonlinear factors: residual functions with full noise models, optionally robust, many of one shape together.

    phi_i(x) = exp( -rho( || r_i(x_i1, ..., x_in) ||_{R_i} ) ),      i = 1..N,    rho(s) = s^2 / 2 unless robust

Linearised at a point, with J_k = dr/dx_k, W R W^T = 1 and the weight w of the robust loss there,

    || sqrt(w) ( sum_k W J_k delta_k + W r ) ||^2,

a native Jacobian factor on the increments delta, which `factors.solver.solve` uses. One call of the residual function
serves all N: what costs tens of microseconds a factor in a loop costs a few.

For GTSAM graphs of one's own there are `gtsam.CustomFactor`s, whose callbacks copy all Values at each linearisation.
GTSAM trusts them: an unset Jacobian or one of a wrong shape crashes the interpreter, NaN spoils the solution. Ours hand
over nothing unchecked; whatever goes wrong in a user's function travels through GTSAM's C++ to the caller as a
`FactorError`. Right for batch optimisers, which leave the values they were given untouched; an exception within
`ISAM2.update` leaves that object unusable.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.gaussian import gaussian_graph, whitened_factors
from factors.manifolds import (
    Variable,
    Vector,
    central_differences,
    read_states,
    wrap_angles,
)
from factors.robust import Mixture, RobustLoss
from factors.validation import (
    FactorError,
    FloatArray,
    KeyArray,
    checked,
    checked_covariances,
    checked_key_rows,
    checked_keys,
    format_keys,
    whiteners,
)

IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ResidualFactors:
    """N factors from one residual function over stacked states.

    rows: keys (N, n), distinct within a row; variables: the type of each column, or the dimension of a vector;
    residual(*states) -> (N, m) from states (N, d_k), poses (N, 3, 3) or (N, 4, 4), in the order of the columns;
    covariances: (N, m, m), or one (m, m) for all; jacobians(*states) -> one (N, m, d_k) a column (d_k: of a pose's
    delta), by central differences when absent, which needs vectors; angles: components of the residual that are angles
    in rad and are wrapped into [-pi, pi); name: for messages. Row i of what a function returns must depend on row i of
    its arguments alone. single: N = 1, and the functions take and give the states, residual and Jacobians of that one,
    see `residual_factor`.

    The functions may raise what they like: it comes out as a `FactorError` that names the factors, as does a result of
    a wrong shape or with numbers that are not finite. Picklable if the functions are.
    """

    rows: KeyArray
    variables: Sequence[Variable | int]
    residual: Callable[..., ArrayLike]
    covariances: FloatArray
    jacobians: Callable[..., Sequence[ArrayLike]] | None = None
    robust: RobustLoss | None = None
    angles: tuple[int, ...] = ()
    name: str = "factors"
    single: bool = False
    types: tuple[Variable, ...] = field(init=False, repr=False)
    _whiteners: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        rows = checked_key_rows("rows", self.rows, len(self.variables))
        types = tuple(Vector(one) if isinstance(one, int | np.integer) else one for one in self.variables)
        if self.jacobians is None and not self.single and not all(isinstance(one, Vector) for one in types):
            raise FactorError("jacobians: expected a function, since not all variables are vectors")
        stack = checked_covariances("covariances", self.covariances, len(rows), None).copy()
        if not stack.shape[1]:
            raise FactorError("covariances: expected at least one row")
        if any(not 0 <= component < stack.shape[1] for component in self.angles):
            raise FactorError(f"angles: expected components from 0 to {stack.shape[1] - 1}, got {self.angles}")
        for name, value in (
            ("rows", rows),
            ("types", types),
            ("covariances", stack),
            ("_whiteners", whiteners("covariances", stack)),
        ):
            object.__setattr__(self, name, value)

    def __str__(self) -> str:
        return f"{self.name} on {format_keys(self.rows.ravel())}" if self.single else f"{len(self.rows)} {self.name}"

    @property
    def keys(self) -> tuple[int, ...]:
        """All keys, each once."""
        return tuple(dict.fromkeys(self.rows.ravel().tolist()))

    def states(self, values: gtsam.Values, chosen: IntArray | None = None) -> list[Any]:
        """Return the states of each column, (N, d_k) or (N, 3, 3) or (N, 4, 4); of the rows `chosen` (n,) if given."""
        try:
            if self.single:
                return read_states(values, self.rows[0].tolist(), self.types)
            rows = self.rows if chosen is None else self.rows[chosen]
            return [_column(values, rows[:, k], variable) for k, variable in enumerate(self.types)]
        except FactorError as error:
            raise FactorError(f"{self}: {error}") from error

    def residuals_at(self, states: Sequence[Any]) -> FloatArray:
        """Return the residuals (N, m) at the states of all rows, angles wrapped, not whitened."""
        residual = self._checked("residual", self._called(self.residual, states))
        return wrap_angles(residual, self.angles)

    def jacobians_at(self, states: Sequence[Any]) -> list[FloatArray]:
        """Return the Jacobians of the residuals, one (N, m, dim_k) a column."""
        if self.jacobians is None:
            center = self.residuals_at(states)  # differences from it stay small, so that no angle wraps between two

            def near(*moved: Any) -> FloatArray:
                difference = wrap_angles(self.residuals_at(moved) - center, self.angles)
                return difference[0] if self.single else difference

            found = central_differences(near, states, self.types)
            return [J[None] for J in found] if self.single else found
        given = self._called(self.jacobians, states)
        if not isinstance(given, list | tuple) or len(given) != len(self.types):
            raise FactorError(f"{self}: expected a list of {len(self.types)} Jacobians, one per variable")
        return [
            self._checked(f"Jacobian {k}", J, variable.dim)
            for k, (J, variable) in enumerate(zip(given, self.types, strict=True))
        ]

    def errors(self, values: gtsam.Values, chosen: IntArray | None = None) -> FloatArray:
        """Return the cost rho(|| r_i ||) of each factor, (N,), or of the rows `chosen` (n,)."""
        distances = self._distances(self.residuals_at(self._filled(values, chosen)))
        return _chosen_rows(0.5 * distances**2 if self.robust is None else self.robust.cost(distances), chosen)

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
        states = self._filled(values, chosen)
        residuals = self.residuals_at(states)
        W = np.broadcast_to(self._whiteners, (len(self.rows), *self._whiteners.shape[1:]))
        if self.robust is not None:
            W = W * np.sqrt(self.robust.weight(self._distances(residuals)))[:, None, None]
        return (
            _chosen_rows(W, chosen),
            [_chosen_rows(J, chosen) for J in self.jacobians_at(states)],
            _chosen_rows(residuals, chosen),
        )

    def custom_factors(self, chosen: Iterable[int] | None = None) -> list[gtsam.CustomFactor]:
        """Return the factors, or some, for a GTSAM graph; each evaluates the whole stack.

        A failure in the functions leaves the solver as a `FactorError`.
        """
        return [self._custom(row) for row in (range(len(self.rows)) if chosen is None else chosen)]

    def _custom(self, row: int) -> gtsam.CustomFactor:
        noise = gtsam.noiseModel.Gaussian.Covariance(self.covariances[min(row, len(self.covariances) - 1)])
        loss = self.robust.of_row(row) if isinstance(self.robust, Mixture) else self.robust

        def evaluate(this: gtsam.CustomFactor, values: gtsam.Values, H: gtsam.JacobianVector | None) -> FloatArray:
            try:
                states = self._filled(values, np.array([row]))
                if H is not None:
                    for k, jacobian in enumerate(self.jacobians_at(states)):
                        H[k] = jacobian[row]
                residual: FloatArray = self.residuals_at(states)[row]
                return residual
            finally:
                del this, values, H  # lent for the call only: in the traceback of an exception they would dangle

        return gtsam.CustomFactor(noise if loss is None else loss.model(noise), self.rows[row].tolist(), evaluate)

    def _filled(self, values: gtsam.Values, chosen: IntArray | None) -> list[Any]:
        """States of all rows, as the functions want them: rows not chosen stand where the first chosen one is."""
        states = self.states(values, chosen)
        if self.single or chosen is None or not len(chosen):
            return states
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

    def _called(self, function: Callable[..., Any], states: Sequence[Any]) -> Any:
        try:
            return function(*states)
        except Exception as error:
            raise FactorError(f"{self}: {error if isinstance(error, FactorError) else repr(error)}") from error

    def _checked(self, name: str, value: ArrayLike, *columns: int) -> FloatArray:
        """Return the result of a function as an array (N, m, *columns)."""
        m = self._whiteners.shape[1]
        try:
            if self.single:
                return checked(name, value, (m, *columns))[None]
            return checked(name, value, (len(self.rows), m, *columns))
        except FactorError as error:
            where = self if self.single else f"{self} on {format_keys(self.rows[:, 0])}"
            raise FactorError(f"{where}: {error}") from error


def residual_factor(
    keys: Iterable[int],
    variables: Sequence[Variable | int],
    residual: Callable[..., ArrayLike],
    covariance: ArrayLike,
    jacobians: Callable[..., Sequence[ArrayLike]] | None = None,
    robust: RobustLoss | None = None,
    angles: Sequence[int] = (),
    name: str = "factor",
) -> ResidualFactors:
    """Return one factor from a function of states as their types read them: vectors (d_k,), GTSAM's poses and planes.

    residual(*states) -> (m,), states in the order of the keys; jacobians(*states) -> one (m, dim_k) a key, by central
    differences when absent; covariance: (m, m); the rest as in `ResidualFactors`.
    """
    rows = np.array([checked_keys("keys", keys)], dtype=np.uint64)
    noise = checked("covariance", covariance, (None, None))
    return ResidualFactors(
        rows=rows,
        variables=variables,
        residual=residual,
        covariances=noise,
        jacobians=jacobians,
        robust=robust,
        angles=tuple(angles),
        name=name,
        single=True,
    )


def residual_factors(
    function: Any,
    rows: ArrayLike,
    variables: Sequence[Variable | int],
    covariances: ArrayLike,
    dim: int,
    name: str,
    robust: RobustLoss | None = None,
    angles: Sequence[int] = (),
) -> ResidualFactors:
    """Return the factors of an object with `residual` and `jacobians`; dim: m, of the residuals; the rest as there."""
    keys = np.asarray(rows)
    noise = checked_covariances("covariances", covariances, len(keys), dim)
    return ResidualFactors(
        rows=keys,
        variables=variables,
        residual=function.residual,
        covariances=noise,
        jacobians=function.jacobians,
        robust=robust,
        angles=tuple(angles),
        name=name,
    )


def _column(values: gtsam.Values, keys_of_rows: KeyArray, variable: Variable) -> FloatArray:
    keys, index = np.unique(keys_of_rows, return_inverse=True)
    states = [variable.array(state) for state in read_states(values, keys.tolist(), [variable] * len(keys))]
    shape = (0, variable.dim) if isinstance(variable, Vector) else (0, 1, 1)
    column: FloatArray = np.stack(states)[index] if states else np.empty(shape)
    column.flags.writeable = False
    return column


def _chosen_rows(array: FloatArray, chosen: IntArray | None) -> FloatArray:
    return array if chosen is None else array[chosen]

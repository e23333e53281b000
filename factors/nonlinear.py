"""Nonlinear factors: one with a full noise model, and many of one shape evaluated together.

The general nonlinear factor: a residual function with a full noise model, optionally robust.

    phi(x) = exp( -rho( || r(x_1, ..., x_n) ||_R ) ),      rho(s) = s^2 / 2 unless robust

Linearised at a point, with J_k = dr/dx_k, W R W^T = 1 and the weight w of the robust loss there,

    || sqrt(w) ( sum_k W J_k delta_k + W r ) ||^2,

a native Jacobian factor on the increments delta, which `factors.solver.solve` uses. Many factors of one shape are
better kept together, as `ResidualFactors`.

For GTSAM graphs of one's own a factor is a guarded `gtsam.CustomFactor`, whose callback copies all Values at each
linearisation. GTSAM trusts it: an unset Jacobian or one of a wrong shape crashes the interpreter, NaN spoils the
solution. The guard hands over nothing unchecked; whatever goes wrong in a user's function becomes a `FactorError`:

* `as_custom_factor` lets it travel through GTSAM's C++ to the caller. Right for batch optimisers: the values they were
  given are untouched, and starting again is all there is to do.
* `as_tolerant_custom_factor` lets the solver finish. An exception within `ISAM2.update` leaves that object unusable. So
  the factor calls `on_failure` and stands in with its last good linearisation, extrapolated:
  r(x) = r(x0) + J (x - x0), as if iSAM2 had not relinearised it.

Many nonlinear factors of one shape, evaluated and linearised together.

    phi_i(x) = exp( -rho( || r_i(x_i1, ..., x_in) ||_{R_i} ) ),      i = 1..N

The same factor as `ResidualFactor`, N times, with one call of the residual function for all: what costs
tens of microseconds a factor in a loop costs a few.

Detection of residuals whose angles are not wrapped.

An angle has a branch cut: while a pose turns once round, a component that is one jumps by 2 pi somewhere (in degrees,
by 360). Where the jump goes from pi to -pi, the residual wraps the angle itself, or the measured angle is 0; elsewhere
a small deviation is taken for a full turn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any, Protocol

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.gaussian import gaussian_graph, native_factor, whitened_factors
from factors.manifolds import (
    PlanarPose,
    SpatialPose,
    Variable,
    Vector,
    central_differences,
    read_states,
    stacked_differences,
    wrap_angles,
)
from factors.robust import Mixture, RobustLoss
from factors.validation import (
    FactorError,
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


class Linearisable(Protocol):
    """A factor, or many in one, that GTSAM does not evaluate itself, as `factors.solver.solve` needs it."""

    @property
    def keys(self) -> tuple[int, ...]: ...

    def error(self, values: gtsam.Values) -> float:
        """Return the cost, -log phi, at `values`."""

    def linearise(self, values: gtsam.Values) -> gtsam.GaussianFactor | gtsam.GaussianFactorGraph:
        """Return the factor, or several, on the increments from `values`."""


@dataclass(frozen=True, eq=False)
class ResidualFactor:
    """A factor from a residual function.

    keys: distinct; variables: one a key, saying its type; residual(*states) -> (m,), states in the order of the keys;
    covariance: (m, m) of the residual; jacobians(*states) -> one (m, dim_k) a key, by central differences when absent;
    angles: components of the residual that are angles in rad and are wrapped into [-pi, pi); name: for messages.

    The functions may raise what they like: it comes out as a `FactorError` that names the factor, as does a result of
    a wrong shape or with numbers that are not finite. Picklable if the functions are.
    """

    keys: tuple[int, ...]
    variables: tuple[Variable, ...]
    residual: Callable[..., ArrayLike]
    covariance: FloatArray
    jacobians: Callable[..., Sequence[ArrayLike]] | None = None
    robust: RobustLoss | None = None
    angles: tuple[int, ...] = ()
    name: str = "factor"
    _whitener: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        keys = checked_keys("keys", self.keys)
        if not keys or len(self.variables) != len(keys):
            raise FactorError(f"variables: expected one per key, got {len(self.variables)} for {len(keys)} keys")
        covariance = checked("covariance", self.covariance, (None, None)).copy()
        if not len(covariance):
            raise FactorError("covariance: expected at least one row")
        if any(not 0 <= component < len(covariance) for component in self.angles):
            raise FactorError(f"angles: expected components from 0 to {len(covariance) - 1}, got {self.angles}")
        object.__setattr__(self, "keys", keys)
        object.__setattr__(self, "variables", tuple(self.variables))
        object.__setattr__(self, "covariance", covariance)
        object.__setattr__(self, "_whitener", whitener("covariance", covariance, len(covariance)))

    @property
    def dim(self) -> int:
        """Number of rows of the residual."""
        return len(self.covariance)

    def __str__(self) -> str:
        return f"{self.name} on {format_keys(self.keys)}"

    def states(self, values: gtsam.Values) -> list[Any]:
        """Return the states of the factor's variables."""
        try:
            return read_states(values, self.keys, self.variables)
        except FactorError as error:
            raise FactorError(f"{self}: {error}") from error

    def residual_at(self, states: Sequence[Any]) -> FloatArray:
        """Return the residual (m,), angles wrapped, not whitened."""
        residual = self._called(self.residual, states)
        try:
            return wrap_angles(checked("residual", residual, (self.dim,)), self.angles)
        except FactorError as error:
            raise FactorError(f"{self}: {error}") from error

    def jacobians_at(self, states: Sequence[Any]) -> list[FloatArray]:
        """Return the Jacobians of the residual, one (m, dim_k) a key."""
        if self.jacobians is None:
            center = self.residual_at(states)  # differences from it stay small, so that no angle wraps between two

            def near(*moved: Any) -> FloatArray:
                return wrap_angles(self.residual_at(moved) - center, self.angles)

            return central_differences(near, states, self.variables)
        given = self._called(self.jacobians, states)
        try:
            if len(given) != len(self.keys):
                raise FactorError(f"expected {len(self.keys)} Jacobians, one per key, got {len(given)}")
            return [
                checked(f"Jacobian {k}", jacobian, (self.dim, variable.dim))
                for k, (jacobian, variable) in enumerate(zip(given, self.variables, strict=True))
            ]
        except (FactorError, TypeError) as error:
            raise FactorError(f"{self}: {error}") from error

    def error(self, values: gtsam.Values) -> float:
        """Return the cost rho(|| r ||) at `values`."""
        whitened = self._whitener @ self.residual_at(self.states(values))
        square = float(whitened @ whitened)
        return 0.5 * square if self.robust is None else float(self.robust.cost(np.sqrt(square)))

    def linearise(self, values: gtsam.Values) -> gtsam.JacobianFactor:
        """Return the factor on the increments from `values`, weighted by the robust loss there."""
        states = self.states(values)
        augmented = np.column_stack([*self.jacobians_at(states), -self.residual_at(states)])
        augmented = self._whitener @ augmented
        if self.robust is not None:
            augmented *= np.sqrt(self.robust.weight(np.linalg.norm(augmented[:, -1])))
        return native_factor(self.keys, [variable.dim for variable in self.variables], np.asfortranarray(augmented))

    def noise_model(self) -> gtsam.noiseModel.Base:
        """Return GTSAM's model of the factor's noise, robust if the factor is."""
        gaussian = gtsam.noiseModel.Gaussian.Covariance(self.covariance)
        return gaussian if self.robust is None else self.robust.model(gaussian)

    def as_custom_factor(self) -> gtsam.CustomFactor:
        """Return the factor for a GTSAM graph; a failure in its functions leaves the solver as a `FactorError`."""

        def evaluate(this: gtsam.CustomFactor, values: gtsam.Values, H: gtsam.JacobianVector | None) -> FloatArray:
            try:
                states = self.states(values)
                if H is not None:
                    _hand_over(self.jacobians_at(states), H)
                return self.residual_at(states)
            finally:
                del this, values, H  # lent for the call only: in the traceback of an exception they would dangle

        return gtsam.CustomFactor(self.noise_model(), list(self.keys), evaluate)

    def as_tolerant_custom_factor(
        self, start: gtsam.Values, on_failure: Callable[[FactorError], None]
    ) -> gtsam.CustomFactor:
        """Return the factor for iSAM2; a failure in its functions goes to `on_failure`, and the solver goes on.

        start: values at which the factor is sound; raises `FactorError` when it is not. on_failure must not raise; a
        list's `append` will do: look into the list after every update.
        """
        good = self.states(start)
        residual, jacobians = self.residual_at(good), self.jacobians_at(good)

        def evaluate(this: gtsam.CustomFactor, values: gtsam.Values, H: gtsam.JacobianVector | None) -> FloatArray:
            nonlocal good, residual, jacobians
            states = self.states(values)
            try:
                if H is None:
                    return self.residual_at(states)
                good, residual, jacobians = states, self.residual_at(states), self.jacobians_at(states)
            except FactorError as error:
                on_failure(error.with_traceback(None))  # whose frames would keep `this` and H, lent for the call only
            if H is not None:
                _hand_over(jacobians, H)
            moved = residual.copy()
            for jacobian, variable, state, now in zip(jacobians, self.variables, good, states, strict=True):
                moved += jacobian @ variable.local(state, now)
            return moved

        return gtsam.CustomFactor(self.noise_model(), list(self.keys), evaluate)

    def _called(self, function: Callable[..., Any], states: Sequence[Any]) -> Any:
        try:
            return function(*states)
        except Exception as error:
            raise FactorError(f"{self}: {error if isinstance(error, FactorError) else repr(error)}") from error


def _hand_over(jacobians: Sequence[FloatArray], H: gtsam.JacobianVector) -> None:
    for k, jacobian in enumerate(jacobians):
        H[k] = jacobian


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


_STEPS = 16  # of a full turn
_HALVINGS = 24  # of a step, which leave 2e-8 rad
_FULL = np.array([2 * np.pi, 360.0])
_SAME = 1e-4  # of a full turn


def unwrapped_angles(factor: ResidualFactor, states: Sequence[Any]) -> tuple[int, ...]:
    """Components of the residual that are angles, unwrapped, and are not named in `angles`.

    states: of the factor's variables. Poses among them are turned about their vertical, one at a time; without poses
    nothing is found.
    """
    found: set[int] = set()
    for place, variable in enumerate(factor.variables):
        if isinstance(variable, PlanarPose | SpatialPose):
            try:
                found |= _jumps(factor, states, place)
            except FactorError:  # a pose that turned too far, to where the factor is undefined
                continue
    return tuple(sorted(found - set(factor.angles)))


def _jumps(factor: ResidualFactor, states: Sequence[Any], place: int) -> set[int]:
    """Components that jump by a full turn, not from half of one to minus half, while one pose turns."""
    turns = np.linspace(0.0, 2 * np.pi, _STEPS + 1)
    residuals = [_turned(factor, states, place, turn) for turn in turns]
    found = set()
    for step, (before, after) in enumerate(pairwise(residuals)):
        for component in np.flatnonzero(np.abs(after - before) > np.pi).tolist():
            low, high = turns[step], turns[step + 1]
            ends = before[component], after[component]
            for _ in range(_HALVINGS):
                middle = (low + high) / 2
                at = _turned(factor, states, place, middle)[component]
                if abs(at - ends[0]) > abs(ends[1] - at):
                    high, ends = middle, (ends[0], at)
                else:
                    low, ends = middle, (at, ends[1])
            jump = abs(ends[1] - ends[0])
            whole = (np.abs(jump / _FULL - 1) < _SAME).any()
            if whole and abs(abs(ends[0]) / jump - 0.5) > _SAME:
                found.add(component)
    return found


def _turned(factor: ResidualFactor, states: Sequence[Any], place: int, turn: float) -> FloatArray:
    delta = np.zeros(factor.variables[place].dim)
    delta[2] = turn  # about the vertical, in the plane and in space
    moved = list(states)
    moved[place] = factor.variables[place].retract(states[place], delta)
    return factor.residual_at(moved)

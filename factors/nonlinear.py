"""The general nonlinear factor: a residual function with a full noise model, optionally robust.

    phi(x) = exp( -rho( || r(x_1, ..., x_n) ||_R ) ),      rho(s) = s^2 / 2 unless robust

Linearised at a point, with J_k = dr/dx_k, W R W^T = 1 and the weight w of the robust loss there,

    || sqrt(w) ( sum_k W J_k delta_k + W r ) ||^2,

a native Jacobian factor on the increments delta, which `factors.solver.solve` uses. Many factors of one shape are
better kept together: `factors.stacked`.

For GTSAM graphs of one's own a factor is a guarded `gtsam.CustomFactor`, whose callback copies all Values at each
linearisation. GTSAM trusts it: an unset Jacobian or one of a wrong shape crashes the interpreter, NaN spoils the
solution. The guard hands over nothing unchecked; whatever goes wrong in a user's function becomes a `FactorError`:

* `as_custom_factor` lets it travel through GTSAM's C++ to the caller. Right for batch optimisers: the values they were
  given are untouched, and starting again is all there is to do.
* `as_tolerant_custom_factor` lets the solver finish. An exception within `ISAM2.update` leaves that object unusable. So
  the factor calls `on_failure` and stands in with its last good linearisation, extrapolated:
  r(x) = r(x0) + J (x - x0), as if iSAM2 had not relinearised it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors.differences import central_differences, wrap_angles
from factors.errors import FactorError
from factors.gaussian import native_factor
from factors.robust import RobustLoss
from factors.validation import FloatArray, checked, checked_keys, format_keys, whitener
from factors.variables import Variable, read_states


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

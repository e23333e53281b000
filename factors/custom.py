"""A factor of ours as a guarded `gtsam.CustomFactor`, for those who build their own GTSAM graphs.

GTSAM trusts the callback: an unset Jacobian or one of a wrong shape crashes the interpreter, NaN spoils the solution.
The guard hands over nothing that has not been checked, so whatever goes wrong in the researcher's function becomes a
`FactorError`. What then? Two answers:

* `custom_factor` lets it travel through GTSAM's C++ to the caller. Right for batch optimisers: the values they were
  given are untouched, and starting again is all there is to do.
* `tolerant_custom_factor` lets the solver finish. An exception within `ISAM2.update` leaves that object unusable, with
  all it has learnt. So the factor tells `on_failure` and stands in with its last good linearisation, extrapolated:
  r(x) = r(x0) + J (x - x0), which is what it would have contributed had iSAM2 not relinearised it. It starts from one
  at `start`, checked before GTSAM sees the factor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol

import gtsam
import numpy as np

from factors.errors import FactorError
from factors.validation import FloatArray, format_keys
from factors.variables import Variable


class Evaluable(Protocol):
    """A factor that can be evaluated piece by piece; every result comes checked, or as a `FactorError`."""

    @property
    def keys(self) -> tuple[int, ...]: ...
    @property
    def variables(self) -> tuple[Variable, ...]: ...
    def states(self, values: gtsam.Values) -> list[Any]: ...
    def residual_at(self, states: Sequence[Any]) -> FloatArray: ...
    def jacobians_at(self, states: Sequence[Any]) -> list[FloatArray]: ...
    def noise_model(self) -> gtsam.noiseModel.Base: ...


def custom_factor(factor: Evaluable) -> gtsam.CustomFactor:
    """Return `factor` for a GTSAM graph; a failure in its functions leaves the solver as a `FactorError`."""

    def evaluate(this: gtsam.CustomFactor, values: gtsam.Values, H: gtsam.JacobianVector | None) -> FloatArray:
        try:
            states = factor.states(values)
            if H is not None:
                _hand_over(factor.jacobians_at(states), H)
            return factor.residual_at(states)
        finally:
            del this, values, H  # lent for the call only: in the traceback of an exception they would dangle

    return gtsam.CustomFactor(factor.noise_model(), list(factor.keys), evaluate)


def tolerant_custom_factor(
    factor: Evaluable, start: gtsam.Values, on_failure: Callable[[FactorError], None]
) -> gtsam.CustomFactor:
    """Return `factor` for iSAM2; a failure in its functions goes to `on_failure`, and the solver goes on.

    start: values at which the factor is sound; raises `FactorError` when it is not. on_failure must not raise; a list's
    `append` will do: look into the list after every update.
    """
    good = factor.states(start)
    residual, jacobians = factor.residual_at(good), factor.jacobians_at(good)

    def evaluate(this: gtsam.CustomFactor, values: gtsam.Values, H: gtsam.JacobianVector | None) -> FloatArray:
        nonlocal good, residual, jacobians
        states = factor.states(values)
        try:
            if H is None:
                return factor.residual_at(states)
            good, residual, jacobians = states, factor.residual_at(states), factor.jacobians_at(states)
        except FactorError as error:
            on_failure(error.with_traceback(None))  # whose frames would keep `this` and H, lent for the call only
        if H is not None:
            _hand_over(jacobians, H)
        moved = residual.copy()
        for jacobian, variable, state, now in zip(jacobians, factor.variables, good, states, strict=True):
            moved += jacobian @ variable.local(state, now)
        return moved

    return gtsam.CustomFactor(factor.noise_model(), list(factor.keys), evaluate)


def custom_factors(graph: gtsam.NonlinearFactorGraph) -> list[gtsam.CustomFactor]:
    """The factors of a graph that call back to Python, ours or not."""
    factors = (graph.at(i) for i in range(graph.size()) if graph.exists(i))
    return [factor for factor in factors if isinstance(factor, gtsam.CustomFactor)]


def check_jacobians(factors: Iterable[gtsam.CustomFactor], values: gtsam.Values) -> None:
    """Raise `FactorError` for a factor whose Jacobians at `values` would crash GTSAM: unset or of a wrong shape."""
    dims: dict[int, int] = {}
    for factor in factors:
        keys, dims = factor.keys(), dims or values.dims()
        H = gtsam.JacobianVector([np.empty((0, 0)) for _ in keys])
        rows = len(factor.unwhitenedError(values, H))
        for key, jacobian in zip(keys, H, strict=True):
            shape = (rows, dims[key])
            if jacobian.shape != shape or not np.isfinite(jacobian).all():
                where = f"CustomFactor of {format_keys(keys)}: Jacobian by {format_keys([key])}"
                got = f"shape {jacobian.shape}" if jacobian.size else "none"
                raise FactorError(f"{where}: expected finite numbers of shape {shape} in H, got {got}")


def _hand_over(jacobians: Sequence[FloatArray], H: gtsam.JacobianVector) -> None:
    for k, jacobian in enumerate(jacobians):
        H[k] = jacobian

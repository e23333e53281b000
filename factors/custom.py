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

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import gtsam

from factors.errors import FactorError
from factors.validation import FloatArray
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


def _hand_over(jacobians: Sequence[FloatArray], H: gtsam.JacobianVector) -> None:
    for k, jacobian in enumerate(jacobians):
        H[k] = jacobian

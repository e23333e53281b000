"""Jacobians by central differences, on any manifold.

    J e_i = ( f(x + h_i e_i) - f(x - h_i e_i) ) / (2 h_i),      h_i = (eps max(1, |x_i|))^(1/3)

The truncation error is h^2 f''' / 6, the rounding error eps |f| / h; with |f| like |x| and f''' of order one this h
balances them, leaving about 1e-10 near the origin and 1e-8 a kilometre away.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from factors.validation import FloatArray
from factors.variables import Variable


def central_differences(
    function: Callable[..., FloatArray], states: Sequence[Any], variables: Sequence[Variable]
) -> list[FloatArray]:
    """Return the Jacobian (m, dim_k) of `function(*states)`, of shape (m,), with respect to each state."""
    jacobians = []
    for k, (state, variable) in enumerate(zip(states, variables, strict=True)):
        steps = np.cbrt(np.finfo(float).eps * np.maximum(1.0, variable.size(state)))
        columns = []
        for step, direction in zip(steps, np.eye(variable.dim), strict=True):
            ahead, behind = list(states), list(states)
            ahead[k] = variable.retract(state, step * direction)
            behind[k] = variable.retract(state, -step * direction)
            columns.append((np.asarray(function(*ahead)) - np.asarray(function(*behind))) / (2 * step))
        jacobians.append(np.stack(columns, axis=-1))
    return jacobians


def stacked_differences(function: Callable[..., FloatArray], states: Sequence[FloatArray]) -> list[FloatArray]:
    """Return the Jacobians (..., m, d_k) of `function(*states)`, (..., m), on vectors, for any number of them at once.

    states[k]: (..., d_k); entry i of the function's value must depend on entry i of its arguments alone.
    """
    jacobians = []
    for k, state in enumerate(states):
        steps = np.cbrt(np.finfo(float).eps * np.maximum(1.0, np.abs(state)))
        columns = []
        for i in range(state.shape[-1]):
            ahead, behind = list(states), list(states)
            ahead[k], behind[k] = state.copy(), state.copy()
            ahead[k][..., i] += steps[..., i]
            behind[k][..., i] -= steps[..., i]
            columns.append((function(*ahead) - function(*behind)) / (2 * steps[..., i, None]))
        jacobians.append(np.stack(columns, axis=-1))
    return jacobians


def wrap_angles(residual: FloatArray, components: Sequence[int]) -> FloatArray:
    """Return `residual` (..., m) with these components, angles in rad, brought into [-pi, pi)."""
    if not components:
        return residual
    wrapped = residual.copy()
    for i in components:
        wrapped[..., i] = (residual[..., i] + np.pi) % (2 * np.pi) - np.pi
    return wrapped

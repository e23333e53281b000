"""Checks of the factors that a running graph takes, before GTSAM's C++ sees them.

| given | becomes |
|---|---|
| `gtsam.JacobianFactor`, linear, on vectors themselves | a row of the `LinearGroup` of all that come with it |
| `factors.ResidualFactors` | a `StackedGroup` |
| anything else with `keys`, `error` and `linearise` (`factors.Linearisable`) | a `SingleGroup` |
| `gtsam.CustomFactor` | a `CustomGroup` |
| any other `gtsam.NonlinearFactor`; a graph of such | a `NativeGroup` each |

GTSAM reads beyond the end of a vector of another dimension than its factor's, answers hard constraints with a system
that least squares cannot take, and takes a `LinearContainerFactor` without a linearisation point for one at any point.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import gtsam
import numpy as np

from factors import (
    Linearisable,
    OrientedPlane,
    PlanarPose,
    ResidualFactor,
    ResidualFactors,
    SpatialPose,
    Vector,
    unwrapped_angles,
)
from saga_fg.graph.errors import GraphError
from saga_fg.graph.factor_groups import (
    CustomGroup,
    FactorGroup,
    LinearGroup,
    NativeGroup,
    SingleGroup,
    StackedGroup,
    first_residual,
    members,
)
from saga_fg.graph.keys import described
from saga_fg.graph.linearisation_point import LARGEST
from saga_fg.graph.variables import GraphVariable

Factor = gtsam.JacobianFactor | gtsam.NonlinearFactor | gtsam.NonlinearFactorGraph | Linearisable
_EXPECTED = "expected a gtsam.JacobianFactor, a GTSAM nonlinear factor, or a factor with keys, error and linearise"


def grouped(provider: str, factors: Any, variables: Mapping[int, GraphVariable]) -> list[FactorGroup]:
    """Return the groups of what a provider gave. Raises `GraphError`, naming provider, factor and variables."""
    if isinstance(factors, str | bytes) or not isinstance(factors, Iterable | gtsam.NonlinearFactorGraph):
        raise GraphError(f"provider {provider}: expected a list of factors, got {type(factors).__name__}")
    groups: list[FactorGroup] = []
    linear: list[gtsam.JacobianFactor] = []
    for factor in _flat(factors):
        if isinstance(factor, gtsam.JacobianFactor):
            linear.append(factor)
        else:
            groups.append(_group(provider, factor))
    if linear:
        groups.append(LinearGroup(tuple(linear), tuple(tuple(factor.keys()) for factor in linear)))
    for group in groups:
        _check_variables(provider, group, variables)
    return [group for group in groups if group.rows]


def _flat(factors: Any) -> Iterable[Any]:
    for factor in _members(factors):
        if isinstance(factor, gtsam.NonlinearFactorGraph):
            yield from _members(factor)
        else:
            yield factor


def _members(factors: Any) -> Iterable[Any]:
    if isinstance(factors, gtsam.NonlinearFactorGraph):
        return members(factors)
    return list(factors)


def _group(provider: str, factor: Any) -> FactorGroup:
    kind = type(factor).__name__
    if isinstance(factor, ResidualFactors):
        return StackedGroup(factor, tuple(map(tuple, factor.rows.tolist())))
    if isinstance(factor, gtsam.LinearContainerFactor):
        raise GraphError(f"provider {provider}: {kind}: expected the linear factor itself, a gtsam.JacobianFactor")
    if isinstance(factor, gtsam.NonlinearFactor):
        rows = (tuple(factor.keys()),)
        if not rows[0]:
            raise GraphError(f"provider {provider}: {kind}: expected a factor with variables")
        if isinstance(factor, gtsam.NoiseModelFactor):
            noise = factor.noiseModel()
            if noise is None or noise.isConstrained():
                raise GraphError(f"provider {provider}: {kind}: expected noise with variances, no hard constraint")
        if isinstance(factor, gtsam.CustomFactor):
            return CustomGroup(factor, rows)
        return NativeGroup(factor, rows, kind)
    if all(callable(getattr(factor, name, None)) for name in ("error", "linearise")) and hasattr(factor, "keys"):
        return SingleGroup(factor, (_given_keys(provider, factor),), str(getattr(factor, "name", kind)))
    raise GraphError(f"provider {provider}: {_EXPECTED}, got {kind}")


def _given_keys(provider: str, factor: Any) -> tuple[int, ...]:
    try:
        keys = tuple(int(key) for key in factor.keys)
    except (TypeError, ValueError) as error:
        raise GraphError(f"provider {provider}: {type(factor).__name__}: expected keys, got {factor.keys!r}") from error
    if not keys or len(set(keys)) != len(keys):
        raise GraphError(f"provider {provider}: {type(factor).__name__}: expected distinct keys, got {keys}")
    return keys


def _check_variables(provider: str, group: FactorGroup, variables: Mapping[int, GraphVariable]) -> None:
    """Each variable is there, of the type and dimension that its factor expects."""
    for row, keys in enumerate(group.rows):
        unknown = [key for key in keys if key not in variables]
        if unknown:
            raise GraphError(
                f"provider {provider}: {group.name}: expected variables of the graph, "
                f"{described(unknown[0])} is none: never added, or marginalised"
            )
        if len(set(keys)) != len(keys):
            raise GraphError(f"provider {provider}: {group.name}: {variables[keys[0]]}: one variable occurs twice")
        mine = [variables[key] for key in keys]
        wrong = _misfit(group, row, mine)
        if wrong:
            names = ", ".join(map(str, mine))
            raise GraphError(f"provider {provider}: {group.name} on {names}: {wrong}")


def check_angles(
    provider: str, group: FactorGroup, variables: Mapping[int, GraphVariable], values: gtsam.Values
) -> None:
    """Raise `GraphError` if the first residual of a group has an angle that nobody wraps."""
    factor = first_residual(group)
    if factor is not None and (angles := unwrapped_angles(factor, factor.states(values))):
        named = ", ".join(str(variables[key]) for key in factor.keys)
        raise GraphError(
            f"provider {provider}: {factor.name} on {named}: component {angles[0]} of the residual jumps by a full "
            f"turn while the pose turns; expected rad, and angles={factor.angles + angles} in the factor"
        )


def _misfit(group: FactorGroup, row: int, variables: Sequence[GraphVariable]) -> str:
    """Describe what does not fit together; "" if everything does."""
    types = [variable.type for variable in variables]
    total = sum(variable.dim for variable in variables)
    if isinstance(group, LinearGroup):
        factor = group.factors[row]
        if not all(isinstance(kind, Vector) for kind in types):
            return "expected vectors: a linear factor speaks of the variables themselves"
        if factor.cols() - 1 != total:
            return f"expected {total} columns, as the variables have dimensions, got {factor.cols() - 1}"
        if factor.isConstrained():
            return "expected noise with variances, no hard constraint"
        if not (np.abs(factor.augmentedJacobian()) <= LARGEST).all():
            return f"expected finite numbers, at most {LARGEST:g} standard deviations"
    elif isinstance(group, StackedGroup):
        expected = [Vector(dim) if isinstance(dim, int | np.integer) else dim for dim in group.factors.dims]
        plain = [
            kind if isinstance(kind, PlanarPose | SpatialPose | OrientedPlane) else Vector(kind.dim) for kind in types
        ]
        return _types(expected, plain) if row == 0 or expected != plain else ""
    elif isinstance(group, SingleGroup) and isinstance(group.factor, ResidualFactor):
        return _types(group.factor.variables, types)
    elif isinstance(group, NativeGroup):
        lengths = _lengths(group.factor)
        if lengths is not None and any(kind != Vector(lengths) for kind in types):
            return f"expected vectors of {lengths} entries, got {', '.join(map(str, types))}"
    return ""


def _types(expected: Sequence[Any], got: Sequence[Any]) -> str:
    if list(expected) == list(got):
        return ""
    return f"expected variables {', '.join(map(str, expected))}, got {', '.join(map(str, got))}"


def _lengths(factor: gtsam.NonlinearFactor) -> int | None:
    """Length of the vectors of a factor that GTSAM does not check itself."""
    if isinstance(factor, gtsam.PriorFactorVector):
        return len(factor.prior())
    if isinstance(factor, gtsam.BetweenFactorVector):
        return len(factor.measured())
    return None

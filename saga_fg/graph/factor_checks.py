"""Checks of the factors that a running graph takes, and error messages that name their variables.

| given | becomes |
|---|---|
| `gtsam.JacobianFactor`, linear, on vectors themselves | a row of the `LinearGroup` of all that come with it |
| `factors.GaussianFactors` | a `GaussianGroup` |
| `factors.ResidualFactors` | a `StackedGroup` |
| anything else with `keys`, `error` and `linearise` (`factors.Linearisable`) | a `SingleGroup` |
| `gtsam.CustomFactor` | a `CustomGroup` |
| any other `gtsam.NonlinearFactor`; a graph of such | a `NativeGroup` each |

GTSAM reads beyond the end of a vector of another dimension than its factor's, answers hard constraints with a system
that least squares cannot take, and takes a `LinearContainerFactor` without a linearisation point for one at any point.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import gtsam
import numpy as np

from factors import (
    FactorError,
    GaussianFactors,
    Linearisable,
    OrientedPlane,
    PlanarPose,
    ResidualFactor,
    ResidualFactors,
    SingularSystemError,
    SpatialPose,
    Vector,
    unwrapped_angles,
)
from factors.validation import format_key
from saga_fg.errors import InputError
from saga_fg.graph.factor_groups import (
    CustomGroup,
    FactorGroup,
    GaussianGroup,
    HeldGroup,
    LinearGroup,
    NativeGroup,
    SingleGroup,
    StackedGroup,
    WhitenedRows,
    first_residual,
    members,
)
from saga_fg.graph.variables import LARGEST_INCREMENT, GraphError, GraphVariable, UndeterminedError, described
from saga_fg.numerics.arrays import IntArray

Factor = gtsam.JacobianFactor | GaussianFactors | gtsam.NonlinearFactor | gtsam.NonlinearFactorGraph | Linearisable
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
    for factor in linear:
        _check_linear(provider, factor, variables)
    if linear:
        groups.append(LinearGroup.of(linear, variables))
    for group in groups:
        check_variables(provider, group, range(len(group.rows)), variables)
    return [group for group in groups if group.rows]


def mentioned_keys(factors: Any) -> set[int]:
    """Return the keys of all factors that a provider gave, as far as they are such; `grouped` has the checks."""
    if isinstance(factors, str | bytes) or not isinstance(factors, Iterable | gtsam.NonlinearFactorGraph):
        return set()
    keys = set[int]()
    for factor in _flat(factors):
        given = getattr(factor, "keys", ())
        with contextlib.suppress(Exception):  # a user's object: anything
            keys.update(given() if callable(given) else given)
    return keys


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
    if isinstance(factor, GaussianFactors):
        return GaussianGroup(factor)
    if isinstance(factor, ResidualFactors):
        return StackedGroup(factor)
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


def check_variables(
    provider: str, group: FactorGroup, rows: Sequence[int], variables: Mapping[int, GraphVariable]
) -> None:
    """Raise `GraphError` unless each variable of some rows is there, of the type and dimension that they expect."""
    if isinstance(group, GaussianGroup) and len(rows) == len(group.rows) and _fits(group.factors, variables):
        return
    for row in rows:
        mine = _present(provider, group.name, group.rows[row], variables)
        _check_fit(provider, group.name, mine, _misfit(group, row, mine))


def _check_linear(provider: str, factor: gtsam.JacobianFactor, variables: Mapping[int, GraphVariable]) -> None:
    """Each variable of a factor of GTSAM's is there, and has its number of columns."""
    mine = _present(provider, "linear factor", tuple(factor.keys()), variables)
    total, wrong = sum(variable.dim for variable in mine), ""
    if factor.cols() - 1 != total:
        wrong = f"expected {total} columns, as the variables have dimensions, got {factor.cols() - 1}"
    elif factor.isConstrained():
        wrong = "expected noise with variances, no hard constraint"
    elif not (np.abs(factor.augmentedJacobian()) <= LARGEST_INCREMENT).all():
        wrong = f"expected finite numbers, at most {LARGEST_INCREMENT:g} standard deviations"
    _check_fit(provider, "linear factor", mine, wrong)


def _present(
    provider: str, name: str, keys: Sequence[int], variables: Mapping[int, GraphVariable]
) -> list[GraphVariable]:
    unknown = [key for key in keys if key not in variables]
    if unknown:
        raise GraphError(
            f"provider {provider}: {name}: expected variables of the graph, "
            f"{described(unknown[0])} is none: never added, or marginalised"
        )
    if len(set(keys)) != len(keys):
        raise GraphError(f"provider {provider}: {name}: {variables[keys[0]]}: one variable occurs twice")
    return [variables[key] for key in keys]


def _check_fit(provider: str, name: str, variables: Sequence[GraphVariable], wrong: str) -> None:
    if wrong:
        raise GraphError(f"provider {provider}: {name} on {', '.join(map(str, variables))}: {wrong}")


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
    if isinstance(group, LinearGroup) and not all(isinstance(kind, Vector) for kind in types):
        return "expected vectors: a linear factor speaks of the variables themselves"
    if isinstance(group, WhitenedRows):
        if tuple(variable.dim for variable in variables) != group.dims[row]:
            return f"expected variables of dimensions {group.dims[row]}"
    elif isinstance(group, GaussianGroup):
        if not all(kind == Vector(dim) for kind, dim in zip(types, group.factors.dims, strict=True)):
            return f"expected vectors of {group.factors.dims} entries, got {', '.join(map(str, types))}"
        if not (np.abs(group.factors.augmented[row]) <= LARGEST_INCREMENT).all():
            return f"expected finite numbers, at most {LARGEST_INCREMENT:g} standard deviations"
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


def _fits(factors: GaussianFactors, variables: Mapping[int, GraphVariable]) -> bool:
    """Whether all variables of linear factors are vectors of the right dimensions, and all numbers finite."""
    for column, dim in zip(factors.rows.T.tolist(), factors.dims, strict=True):
        vector = Vector(dim)
        if any((one := variables.get(key)) is None or one.type != vector for key in column):
            return False
    return bool((np.abs(factors.augmented) <= LARGEST_INCREMENT).all())


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


Variables = Mapping[int, GraphVariable]


def solver_error(variables: Variables, groups: Mapping[int, HeldGroup], error: Exception) -> GraphError:
    """Return a solver's error in the names of the graph: an `UndeterminedError` where the system is singular."""
    if not isinstance(error, SingularSystemError) or not error.keys:
        return GraphError(with_names(variables, str(error), variables))
    names = [str(variables[key]) if key in variables else described(key) for key in error.keys[:8]]
    more = f" and {len(error.keys) - 8} more" if len(error.keys) > 8 else ""
    first = error.keys[0]
    its = f" (factors on {names[0]}: {_factors_on(groups.values(), first)})" if first in variables else ""
    return UndeterminedError(
        f"{', '.join(names)}{more}: not determined by the factors{its}; "
        "expected a prior, or measurements of all components",
        error.keys,
    )


def factor_error(variables: Variables, held: HeldGroup, rows: IntArray, error: Exception) -> GraphError:
    """Return the error of factors, with their provider, kind and variables."""
    keys = dict.fromkeys(key for row in rows.tolist() for key in held.factors.rows[row])
    named = [str(variables[key]) for key in list(keys)[:6]] + ["..."] * (len(keys) > 6)
    expected = isinstance(error, FactorError | InputError)
    text = " ".join(str(error).split()) if expected else " ".join(repr(error).split())
    where = f"{held.factors.name} on {', '.join(named)}: "
    return GraphError(f"provider {held.provider}: {where}{with_names(variables, text, keys).removeprefix(where)[:500]}")


def with_names(variables: Variables, text: str, keys: Iterable[int]) -> str:
    """Replace keys in a text by the names of their variables."""
    for key in keys:
        if format_key(key) in text:
            text = text.replace(format_key(key), str(variables[key]))
    return text


def _factors_on(groups: Iterable[HeldGroup], key: int) -> str:
    """Describe the factors on a variable."""
    counts: dict[str, int] = {}
    for held in groups:
        mine = sum(key in held.factors.rows[row] for row in held.rows.tolist())
        if mine:
            counts[held.factors.name] = counts.get(held.factors.name, 0) + mine
    return ", ".join(f"{count} {name}" for name, count in counts.items()) or "none"

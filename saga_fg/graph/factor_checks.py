"""The door of a running graph: checks of the factors that it takes, and errors that name their variables.

| given | becomes |
|---|---|
| `factors.GaussianFactors`; `gtsam.JacobianFactor`s, on vectors themselves, of one shape | a `LinearGroup` |
| `factors.ResidualFactors` | a `ResidualGroup` |
| `gtsam.CustomFactor`: GTSAM crashes where its function leaves out a Jacobian | the same, by central differences |
| any other `gtsam.NonlinearFactor`; a graph of such | a `NativeGroup` each |

GTSAM reads beyond the end of a vector of another dimension than its factor's, answers hard constraints with a system
that least squares cannot take, and takes a `LinearContainerFactor` without a linearisation point for one at any point.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors import (
    FactorError,
    GaussianFactors,
    ResidualFactors,
    SingularSystemError,
    Variable,
    Vector,
    residual_factor,
)
from factors.manifolds import Manifold
from factors.robust import each_of
from factors.validation import format_key
from saga_fg.errors import InputError
from saga_fg.graph.factor_groups import FactorGroup, HeldGroup, LinearGroup, NativeGroup, ResidualGroup, members
from saga_fg.graph.variables import GraphError, GraphVariable, UndeterminedError, described
from saga_fg.numerics import FloatArray, IntArray

Factor = gtsam.JacobianFactor | GaussianFactors | ResidualFactors | gtsam.NonlinearFactor | gtsam.NonlinearFactorGraph
Variables = Mapping[int, GraphVariable]


def each_factor(provider: str, factors: Any) -> list[Any]:
    """The factors that a provider gave, those of GTSAM's graphs one by one. Raises `GraphError` for other things."""
    if isinstance(factors, gtsam.NonlinearFactorGraph):
        return members(factors)
    if isinstance(factors, str | bytes) or not isinstance(factors, Iterable):
        raise GraphError(f"provider {provider}: expected a list of factors, got {type(factors).__name__}")
    nested = [members(one) if isinstance(one, gtsam.NonlinearFactorGraph) else [one] for one in factors]
    return [factor for some in nested for factor in some]


def mentioned_keys(factors: Sequence[Any]) -> set[int]:
    """Return the keys of factors; `grouped` has the checks."""
    keys = set[int]()
    for factor in factors:
        if isinstance(factor, gtsam.Factor):
            keys.update(factor.keys())
        elif isinstance(factor, GaussianFactors | ResidualFactors):
            keys.update(factor.keys)
    return keys


def grouped(provider: str, factors: Any, variables: Variables) -> list[FactorGroup]:
    """Return the groups of what a provider gave. Raises `GraphError`, naming provider, factor and variables."""
    groups: list[FactorGroup] = []
    alike: dict[tuple[int, ...], list[gtsam.JacobianFactor]] = {}
    for factor in each_factor(provider, factors):
        if isinstance(factor, gtsam.JacobianFactor):
            dims = [variable.dim for variable in _present(provider, "linear factor", factor.keys(), variables)]
            _check_linear(provider, factor, variables)
            alike.setdefault((factor.rows(), *dims), []).append(factor)
        else:
            groups.append(_group(provider, factor, variables))
    groups += [LinearGroup(stacked(some, dims)) for (_, *dims), some in alike.items()]
    for group in groups:
        check_variables(provider, group, range(len(group.rows)), variables)
    return [group for group in groups if group.rows]


def stacked(factors: Sequence[gtsam.JacobianFactor], dims: Sequence[int]) -> GaussianFactors:
    """Factors of one shape as arrays."""
    rows = np.array([list(factor.keys()) for factor in factors], dtype=np.uint64)
    return GaussianFactors(rows, tuple(dims), np.stack([factor.augmentedJacobian().T for factor in factors]))


def _group(provider: str, factor: Any, variables: Variables) -> FactorGroup:
    kind = type(factor).__name__
    if isinstance(factor, GaussianFactors):
        return LinearGroup(factor)
    if isinstance(factor, ResidualFactors):
        return ResidualGroup(factor)
    if isinstance(factor, gtsam.LinearContainerFactor):
        raise GraphError(f"provider {provider}: {kind}: expected the linear factor itself, a gtsam.JacobianFactor")
    if not isinstance(factor, gtsam.NonlinearFactor):
        raise GraphError(
            f"provider {provider}: expected a gtsam.JacobianFactor, a GTSAM nonlinear factor, GaussianFactors or "
            f"ResidualFactors, got {kind}"
        )
    keys = tuple(factor.keys())
    if not keys:
        raise GraphError(f"provider {provider}: {kind}: expected a factor with variables")
    if isinstance(factor, gtsam.NoiseModelFactor):
        noise = factor.noiseModel()
        if noise is None or noise.isConstrained():
            raise GraphError(f"provider {provider}: {kind}: expected noise with variances, no hard constraint")
    if isinstance(factor, gtsam.CustomFactor):
        return ResidualGroup(_differentiated(factor, [one.type for one in _present(provider, kind, keys, variables)]))
    return NativeGroup(factor, (keys,), kind)


def _differentiated(factor: gtsam.CustomFactor, types: Sequence[Variable]) -> ResidualFactors:
    keys, noise = list(factor.keys()), cast("Any", factor.noiseModel())
    gaussian, robust = noise, None
    if isinstance(noise, gtsam.noiseModel.Robust):
        gaussian, robust = noise.noise(), _NativeLoss(noise.robust())

    def residual(*states: Any) -> FloatArray:
        values = gtsam.Values()  # its own variables alone: GTSAM copies all of them for every call
        for key, state in zip(keys, states, strict=True):
            values.insert(key, state)
        return np.asarray(factor.unwhitenedError(values), dtype=np.float64)

    return residual_factor(keys, types, residual, gaussian.covariance(), robust=robust, name="custom factor")


@dataclass(frozen=True)
class _NativeLoss:
    """A robust loss of GTSAM's."""

    estimator: Any

    def cost(self, distance: ArrayLike) -> FloatArray:
        return each_of(self.estimator.loss, distance)

    def weight(self, distance: ArrayLike) -> FloatArray:
        return each_of(self.estimator.weight, distance)

    def model(self, noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Robust:
        return gtsam.noiseModel.Robust.Create(self.estimator, noise)


def check_variables(provider: str, group: FactorGroup, rows: Iterable[int], variables: Variables) -> None:
    """Raise `GraphError` unless each variable of some rows is there, of the type and dimension that they expect."""
    types = group.types
    for row in rows:
        mine = _present(provider, group.name, group.rows[row], variables)
        if types is not None and not all(map(_fits, types, (one.type for one in mine))):
            got = ", ".join(str(one.type) for one in mine)
            _refuse(provider, group.name, mine, f"expected variables {', '.join(map(str, types))}, got {got}")


def _fits(expected: Variable, got: Variable) -> bool:
    """Functions of vectors take all that are read as such."""
    return expected == got or (
        isinstance(expected, Vector) and not isinstance(got, Manifold) and expected.dim == got.dim
    )


def _check_linear(provider: str, factor: gtsam.JacobianFactor, variables: Variables) -> None:
    """The variables of a factor of GTSAM's are vectors, of its number of columns."""
    mine = [variables[key] for key in factor.keys()]  # noqa: SIM118
    total = sum(variable.dim for variable in mine)
    if not all(isinstance(one.type, Vector) for one in mine):
        _refuse(provider, "linear factor", mine, "expected vectors: it speaks of the variables themselves")
    if factor.cols() - 1 != total:
        wrong = f"expected {total} columns, as the variables have dimensions, got {factor.cols() - 1}"
        _refuse(provider, "linear factor", mine, wrong)
    if factor.isConstrained():
        _refuse(provider, "linear factor", mine, "expected noise with variances, no hard constraint")


def _present(provider: str, name: str, keys: Sequence[int], variables: Variables) -> list[GraphVariable]:
    unknown = [key for key in keys if key not in variables]
    if unknown:
        raise GraphError(
            f"provider {provider}: {name}: expected variables of the graph, "
            f"{described(unknown[0])} is none: never added, or marginalised"
        )
    if len(set(keys)) != len(keys):
        raise GraphError(f"provider {provider}: {name}: {variables[keys[0]]}: one variable occurs twice")
    return [variables[key] for key in keys]


def _refuse(provider: str, name: str, variables: Sequence[GraphVariable], wrong: str) -> None:
    raise GraphError(f"provider {provider}: {name} on {', '.join(map(str, variables))}: {wrong}")


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
    name = held.factors.name
    text = re.sub(rf"^(\d+ )?{re.escape(name)}( on [^:]*)?: ", "", text)  # factors name themselves
    where = f"provider {held.provider}: {name} on {', '.join(named)}: "
    return GraphError(where + with_names(variables, text, keys)[:500])


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

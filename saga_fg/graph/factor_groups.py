"""Groups of factors that were added together, and the index of groups by number, name and variable.

Groups of factors that were added together, each factor a row of its group.

A group linearises any of its rows at a `LinearisationPoint`. GTSAM's own factors are linearised by GTSAM, one at a
time; `ResidualFactors` all at once in NumPy. A `gtsam.CustomFactor` is
differentiated numerically: GTSAM crashes where its function leaves out a Jacobian, and does not show the function.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, Self

import gtsam
import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from factors import (
    FactorError,
    GaussianFactors,
    Linearisable,
    ResidualFactor,
    ResidualFactors,
    nonlinear_graph,
    nonlinear_graph_at,
)
from factors.gaussian import gaussian_graph, native_factor, whitened_factors
from factors.manifolds import central_differences
from factors.validation import KeyArray
from saga_fg.graph.variables import LARGEST_INCREMENT, GraphError, GraphVariable, LinearisationPoint
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray

Rows = tuple[tuple[int, ...], ...]


class FactorGroup(Protocol):
    """Factors that are kept together; `rows`: the keys of each, `linear`: whether linearising once is enough."""

    @property
    def name(self) -> str: ...
    @property
    def rows(self) -> Rows: ...
    @property
    def linear(self) -> bool: ...

    def linearised(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.JacobianFactor]:
        """The rows `chosen`, on increments from the base. Raises what the factors raise."""

    def native(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.NonlinearFactor]:
        """The rows `chosen` as GTSAM's own factors."""


class SolvableGroup(FactorGroup, Protocol):
    """A group that GTSAM does not evaluate itself."""

    def error(self, chosen: IntArray, point: LinearisationPoint) -> float:
        """The cost, -log phi, of the rows `chosen` together."""


def members(graph: gtsam.NonlinearFactorGraph) -> list[gtsam.NonlinearFactor]:
    """The factors of a graph."""
    return [graph.at(i) for i in range(graph.size()) if graph.exists(i)]


@dataclass(frozen=True, eq=False)
class WhitenedRows:
    """Linear factors as arrays; dims: of the variables in `rows`; augmented: [A | b] (m, sum(dims) + 1) of each row.

    Raises `GraphError` where they don't fit together, and for numbers that are not finite.
    """

    rows: Rows
    dims: Rows
    augmented: tuple[FloatArray, ...]
    name: str = "linear factor"
    linear: bool = True

    def __post_init__(self) -> None:
        for keys, dims, augmented in zip(self.rows, self.dims, self.augmented, strict=True):
            if len(set(keys)) != len(keys) or len(dims) != len(keys) or min(dims, default=0) < 1:
                raise GraphError(f"{self.name}: expected distinct keys with their dimensions, got {keys} with {dims}")
            if augmented.dtype != np.float64 or augmented.ndim != 2 or augmented.shape[1] != sum(dims) + 1:
                raise GraphError(f"{self.name}: expected {sum(dims) + 1} columns, got shape {augmented.shape}")
            if not (np.abs(augmented) <= LARGEST_INCREMENT).all():
                raise GraphError(
                    f"{self.name}: expected finite numbers, at most {LARGEST_INCREMENT:g} standard deviations"
                )

    @classmethod
    def of(cls, factors: Sequence[gtsam.JacobianFactor], variables: Mapping[int, GraphVariable]) -> Self:
        """The arrays of GTSAM's factors on some variables."""
        rows = tuple(tuple(factor.keys()) for factor in factors)
        dims = tuple(tuple(variables[key].dim for key in keys) for keys in rows)
        return cls(rows, dims, tuple(factor.augmentedJacobian() for factor in factors))

    def factor(self, row: int, augmented: FloatArray) -> gtsam.JacobianFactor:
        """A row's factor, of other numbers."""
        return native_factor(self.rows[row], self.dims[row], augmented)

    @cached_property
    def factors(self) -> tuple[gtsam.JacobianFactor, ...]:
        """Every row as GTSAM's factor."""
        return tuple(self.factor(row, np.asfortranarray(augmented)) for row, augmented in enumerate(self.augmented))


@dataclass(frozen=True, eq=False)
class LinearGroup(WhitenedRows):
    """Linear factors on the variables themselves, which are vectors."""

    def linearised(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.JacobianFactor]:
        result = []
        for row in chosen.tolist():
            augmented = np.array(self.augmented[row], order="F")
            base = np.concatenate([point.base.atVector(key) for key in self.rows[row]])
            augmented[:, -1] -= augmented[:, :-1] @ base
            result.append(self.factor(row, augmented))
        return result

    def native(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.NonlinearFactor]:
        dims = {k: d for row in chosen.tolist() for k, d in zip(self.rows[row], self.dims[row], strict=True)}
        return members(nonlinear_graph([self.factors[row] for row in chosen.tolist()], dims))


@dataclass(frozen=True, eq=False)
class GaussianGroup:
    """Linear factors of one shape on the variables themselves, which are vectors, as arrays."""

    factors: GaussianFactors
    name: str = "linear factor"
    linear: bool = True

    def __post_init__(self) -> None:
        keys, dims, augmented = self.factors.rows, self.factors.dims, self.factors.augmented
        shape = (len(keys), sum(dims) + 1)
        if keys.shape != (len(keys), len(dims)) or augmented.shape[:2] != shape or augmented.dtype != np.float64:
            raise GraphError(f"{self.name}: expected arrays of {shape}, got {keys.shape} and {augmented.shape}")

    @cached_property
    def rows(self) -> Rows:
        return tuple(map(tuple, self.factors.rows.tolist()))

    def linearised(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.JacobianFactor]:
        origins = np.zeros((len(self.rows), sum(self.factors.dims)))
        for row in chosen.tolist():
            origins[row] = np.concatenate([point.base_vector(key) for key in self.rows[row]])
        return self.factors.native(origins, chosen.tolist())

    def native(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.NonlinearFactor]:
        keys = {key for row in chosen.tolist() for key in self.rows[row]}
        dims = dict(zip(keys, point.dims(list(keys)), strict=True))
        return members(nonlinear_graph(self.factors.native(chosen=chosen.tolist()), dims))


@dataclass(frozen=True, eq=False)
class PriorGroup(WhitenedRows):
    """Priors left by marginalised variables: linear factors on increments from the base."""

    name: str = "marginal"

    def linearised(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.JacobianFactor]:
        return [self.factors[row] for row in chosen.tolist()]

    def here(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.JacobianFactor]:
        """Factors on increments from the linearisation point."""
        result = []
        for row in chosen.tolist():
            keys, dims, augmented = self.rows[row], self.dims[row], np.array(self.augmented[row], order="F")
            augmented[:, -1] -= augmented[:, :-1] @ np.concatenate([point.increment(key) for key in keys])
            for key, end, dim in zip(keys, np.cumsum(dims).tolist(), dims, strict=True):
                columns, D = slice(end - dim, end), point.transport(key)
                if D is not None:
                    augmented[:, columns] = augmented[:, columns] @ np.linalg.inv(D)
            result.append(self.factor(row, augmented))
        return result

    def error(self, chosen: IntArray, point: LinearisationPoint) -> float:
        return 0.5 * sum(float(np.sum(f.augmentedJacobian()[:, -1] ** 2)) for f in self.here(chosen, point))

    def native(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.NonlinearFactor]:
        return members(nonlinear_graph_at(self.linearised(chosen, point), point.base))


@dataclass(frozen=True, eq=False)
class StackedGroup:
    """Nonlinear factors of one shape, linearised together."""

    factors: ResidualFactors
    linear: bool = False

    @cached_property
    def rows(self) -> Rows:
        return tuple(map(tuple, self.factors.rows.tolist()))

    @property
    def name(self) -> str:
        return self.factors.name

    def linearised(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.JacobianFactor]:
        W, jacobians, residuals = self.factors.linearisation(point.values, chosen)
        keys, rhs, blocks = self.factors.rows[chosen], -residuals, []
        if point.base is point.values:
            return whitened_factors(keys, W, jacobians, rhs).native()
        states, origins = self.factors.states(point.values, chosen), self.factors.states(point.base, chosen)
        for k, J in enumerate(jacobians):
            column = keys[:, k].tolist()
            if states[k].ndim == 2:  # vectors
                delta = states[k] - origins[k]
            else:
                delta = np.stack([point.increment(key) for key in column])
                D = [point.transport(key) for key in column]
                J = np.stack([a if d is None else a @ d for a, d in zip(J, D, strict=True)])
            rhs = rhs + (J @ delta[:, :, None])[:, :, 0]
            blocks.append(J)
        largest = np.abs(W).max(initial=0.0) * max(np.abs(numbers).max(initial=0.0) for numbers in (rhs, *blocks))
        if not largest <= LARGEST_INCREMENT:
            raise FactorError(f"expected a residual and Jacobians of at most {LARGEST_INCREMENT:g} standard deviations")
        return whitened_factors(keys, W, blocks, rhs).native()

    def error(self, chosen: IntArray, point: LinearisationPoint) -> float:
        return float(self.factors.errors(point.values, chosen).sum())

    def native(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.NonlinearFactor]:
        singles = self.factors.individual_factors()
        return [singles[row].as_custom_factor() for row in chosen.tolist()]


@dataclass(frozen=True, eq=False)
class SingleGroup:
    """One factor of ours or a user's, that linearises itself."""

    factor: Linearisable
    rows: Rows
    name: str
    linear: bool = False

    def linearised(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.JacobianFactor]:
        made = self.factor.linearise(point.values)
        (keys,) = self.rows
        if not isinstance(made, gtsam.GaussianFactor | gtsam.GaussianFactorGraph):
            raise FactorError(f"expected linearise to give a gtsam.GaussianFactor, got {type(made).__name__}")
        graph = gaussian_graph([made]) if isinstance(made, gtsam.GaussianFactor) else made
        if set(graph.keyVector()) != set(keys):
            raise FactorError("expected linearise to speak of all of the factor's keys, and of no others")
        if isinstance(made, gtsam.GaussianFactor):
            return [point.from_base(list(made.keys()), made.augmentedJacobian())]
        A, b = made.jacobian(gtsam.Ordering(list(keys)))
        return [point.from_base(keys, np.column_stack([A, b]))]

    def error(self, chosen: IntArray, point: LinearisationPoint) -> float:
        return self.factor.error(point.values)

    def native(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.NonlinearFactor]:
        if not isinstance(self.factor, ResidualFactor):
            raise FactorError(f"{self.name}: expected a ResidualFactor, which GTSAM's solvers can call")
        return [self.factor.as_custom_factor()]


@dataclass(frozen=True, eq=False)
class NativeGroup:
    """One of GTSAM's nonlinear factors."""

    factor: gtsam.NonlinearFactor
    rows: Rows
    name: str
    linear: bool = False

    def linearised(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.JacobianFactor]:
        made = self.factor.linearize(point.values)
        return [point.from_base(list(made.keys()), made.augmentedJacobian())]

    def native(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.NonlinearFactor]:
        return [self.factor]


@dataclass(frozen=True, eq=False)
class CustomGroup:
    """A `gtsam.CustomFactor`, by central differences of its residual."""

    factor: gtsam.CustomFactor
    rows: Rows
    name: str = "custom factor"
    linear: bool = False

    def linearised(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.JacobianFactor]:
        (keys,) = self.rows
        types = [point.variables[key].type for key in keys]
        states = [kind.read(point.values, key) for key, kind in zip(keys, types, strict=True)]
        noise = self.factor.noiseModel()

        def residual(*moved: Any) -> FloatArray:
            return self._residual(keys, moved)

        r = residual(*states)
        J = central_differences(residual, states, types)
        whitener = noise.noise() if isinstance(noise, gtsam.noiseModel.Robust) else noise
        whitened = np.column_stack([whitener.whiten(column) for column in np.column_stack([*J, -r]).T])
        if isinstance(noise, gtsam.noiseModel.Robust):
            whitened *= np.sqrt(noise.weight(whitened[:, -1]))
        return [point.from_base(keys, whitened)]

    def error(self, chosen: IntArray, point: LinearisationPoint) -> float:
        return float(self.factor.error(point.values))

    def native(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.NonlinearFactor]:
        return [self.factor]

    def _residual(self, keys: Sequence[int], states: Sequence[Any]) -> FloatArray:
        values = gtsam.Values()  # its own variables alone: GTSAM copies all of them for every call
        for key, state in zip(keys, states, strict=True):
            values.insert(key, state)
        residual = np.asarray(self.factor.unwhitenedError(values), dtype=np.float64)
        if len(residual) != self.factor.noiseModel().dim():
            raise FactorError(
                f"expected a residual of {self.factor.noiseModel().dim()} entries, as its noise, got {len(residual)}"
            )
        return residual


@dataclass(frozen=True, eq=False)
class ActiveRows:
    """The rows of a group that are still there, for `factors.solve`."""

    group: SolvableGroup
    chosen: IntArray
    point: LinearisationPoint

    @property
    def keys(self) -> tuple[int, ...]:
        return tuple({key for row in self.chosen.tolist() for key in self.group.rows[row]})

    def error(self, values: gtsam.Values) -> float:
        return self.group.error(self.chosen, LinearisationPoint(self.point.variables, self.point.base, values))

    def linearise(self, values: gtsam.Values) -> gtsam.GaussianFactorGraph:
        if isinstance(self.group, PriorGroup):
            return gaussian_graph(
                self.group.here(self.chosen, LinearisationPoint(self.point.variables, self.point.base, values))
            )
        return gaussian_graph(
            self.group.linearised(self.chosen, LinearisationPoint(self.point.variables, values, values))
        )


@dataclass(frozen=True)
class FactorEntry:
    """Description of a factor: its provider, its kind and its variables."""

    provider: str
    kind: str
    variables: tuple[GraphVariable, ...]

    def __str__(self) -> str:
        return f"{self.kind} on {', '.join(map(str, self.variables))} (provider {self.provider})"


@dataclass(frozen=True, eq=False)
class HeldGroup:
    """Factors in the graph: their provider, their name if any, and active (n,): the rows that are still there."""

    provider: str
    name: Hashable
    factors: FactorGroup
    active: BoolArray

    @property
    def rows(self) -> IntArray:
        """Numbers of the active rows."""
        return np.flatnonzero(self.active)

    @cached_property
    def ties(self) -> KeyArray:
        """(p, 2) the first key of each active row, with each of its keys."""
        rows = (self.factors.rows[row] for row in self.rows.tolist())
        return np.array([(keys[0], key) for keys in rows for key in keys], dtype=np.uint64).reshape(-1, 2)

    @cached_property
    def elimination_order(self) -> tuple[bool, bool, float]:
        """Sort key for elimination: groups that are likely to have the least noise come first.

        Householder's QR loses digits of rows of small numbers where rows of large ones come after them: with intervals
        of a millisecond, whose interactions have next to no noise, three to five digits.
        """
        group, most = self.factors, max(map(len, self.factors.rows))
        sharpest = float(np.abs(group.factors.augmented[:, :-1]).max()) if isinstance(group, GaussianGroup) else most
        return isinstance(group, PriorGroup), most == 1, -sharpest


def first_residual(group: FactorGroup) -> ResidualFactor | None:
    """The first factor of a group that is made of residual functions."""
    if isinstance(group, StackedGroup) and len(group.rows):
        return group.factors.individual_factor(0)
    if isinstance(group, SingleGroup) and isinstance(group.factor, ResidualFactor):
        return group.factor
    return None


class FactorIndex:
    """Groups of factors, each with a number that no other group ever has.

    groups  by number
    fresh   groups that were linearised when they were added, and where all variables still are
    """

    def __init__(self) -> None:
        self.groups: dict[int, HeldGroup] = {}
        self.fresh: dict[int, list[gtsam.JacobianFactor]] = {}
        self._named: dict[tuple[str, Hashable], tuple[int, ...]] = {}  # by provider and name
        self._touching: dict[int, tuple[int, ...]] = {}  # groups with a factor on a variable, now or before
        self._factor_counts: dict[int, int] = {}  # number of factors on each variable
        self._components: Mapping[int, int] | None = None  # until factors tie others
        self.count = 0  # of groups that have been

    def copy(self) -> FactorIndex:
        """An index of its own with the same groups, which are shared."""
        other = FactorIndex()
        other.__dict__ |= {name: dict(held) for name, held in vars(self).items() if isinstance(held, dict)}
        other._components, other.count = self._components, self.count
        return other

    def add_variables(self, keys: Iterable[int]) -> None:
        """Add variables without factors."""
        keys = list(keys)
        self._touching |= dict.fromkeys(keys, ())
        self._factor_counts |= dict.fromkeys(keys, 0)

    def remove_variable(self, key: int) -> None:
        """Remove a variable that no factor is on."""
        del self._touching[key], self._factor_counts[key]

    def add(self, held: HeldGroup) -> int:
        """Add a group; returns its number."""
        self.put(self.count, held)
        return self.count - 1

    def put(self, number: int, held: HeldGroup) -> None:
        """Add a group under a number above all others."""
        self.groups[number], self.count = held, number + 1
        known = self._components or {}
        if any(len(row) > 1 or row[0] not in known for row in held.factors.rows):
            self._components = None
        for key in {key for row in held.factors.rows for key in row}:
            if key in self._touching:
                self._touching[key] += (number,)
        self._count_rows(held.factors, held.rows.tolist(), 1)
        if held.name is not None:
            self._named[held.provider, held.name] = (*self.named(held.provider, held.name), number)

    def remove(self, number: int) -> None:
        """Remove a group."""
        held, self._components = self.groups.pop(number), None
        self.fresh.pop(number, None)
        if held.name is not None:
            rest = tuple(n for n in self._named.pop((held.provider, held.name)) if n != number)
            if rest:
                self._named[held.provider, held.name] = rest
        self._count_rows(held.factors, held.rows.tolist(), -1)
        for key in {key for row in held.factors.rows for key in row}:
            if key in self._touching:
                self._touching[key] = tuple(n for n in self._touching[key] if n != number)

    def deactivate(self, number: int, rows: list[int]) -> None:
        """Take rows out of a group, and the group with its last one."""
        self.fresh.pop(number, None)
        held, self._components = self.groups[number], None
        active = held.active.copy()
        active[rows] = False
        self._count_rows(held.factors, rows, -1)
        self.groups[number] = replace(held, active=active)
        if not active.any():
            self.remove(number)

    def named(self, provider: str, name: Hashable) -> tuple[int, ...]:
        """Numbers of the groups that a provider gave under a name."""
        return self._named.get((provider, name), ())

    def touching(self, key: int) -> tuple[int, ...]:
        """Numbers of the groups with a factor on a variable, now or before."""
        return self._touching[key]

    def without_factors(self) -> list[int]:
        """Variables without any factor."""
        return [key for key, count in self._factor_counts.items() if count == 0]

    def components(self) -> Mapping[int, int]:
        """The component of every variable that has factors: what these tie together, directly or through others."""
        if self._components is None:
            ties = np.concatenate([np.empty((0, 2), dtype=np.uint64), *(held.ties for held in self.groups.values())])
            keys, row = np.unique(ties, return_inverse=True)
            a, b = row.reshape(-1, 2).T
            matrix = scipy.sparse.coo_array((np.ones(len(a)), (a, b)), shape=(len(keys), len(keys)))
            label = connected_components(matrix, directed=False)[1]
            self._components = dict(zip(keys.tolist(), label.tolist(), strict=True))
        return self._components

    def rows_on(self, keys: Collection[int]) -> dict[int, list[int]]:
        """Rows of groups on any of some variables, by the number of the group, the sharpest first."""
        numbers = {number for key in keys for number in self._touching[key]}
        result = {}
        for number in sorted(numbers, key=lambda number: (self.groups[number].elimination_order, number)):
            held = self.groups[number]
            mine = [row for row in held.rows.tolist() if any(key in keys for key in held.factors.rows[row])]
            if mine:
                result[number] = mine
        return result

    def _count_rows(self, group: FactorGroup, rows: list[int], step: int) -> None:
        for row in rows:
            for key in group.rows[row]:
                self._factor_counts[key] += step

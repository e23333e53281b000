"""Groups of factors of one shape that were added together, and the index of groups by number, name and variable.

Each factor is a row of its group. A group linearises any of its rows at a `LinearisationPoint`: linear factors and
`ResidualFactors` all at once in NumPy, GTSAM's own by GTSAM, one at a time.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Protocol

import gtsam
import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from factors import (
    FactorError,
    GaussianFactors,
    ResidualFactors,
    Variable,
    Vector,
    gaussian_graph,
    nonlinear_graph,
)
from factors.gaussian import nonlinear_graph_at, whitened_factors
from factors.validation import KeyArray, format_keys
from saga_fg.graph.variables import LARGEST_INCREMENT, GraphError, GraphVariable, LinearisationPoint
from saga_fg.numerics import BoolArray, IntArray

Rows = tuple[tuple[int, ...], ...]


class FactorGroup(Protocol):
    """Factors of one shape; `rows`: the keys of each; `types`: of their variables, None where GTSAM checks them;
    `linear`: whether linearising once is enough.
    """

    linear: ClassVar[bool]

    @property
    def name(self) -> str: ...
    @property
    def rows(self) -> Rows: ...
    @property
    def types(self) -> tuple[Variable, ...] | None: ...

    def linearised(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.JacobianFactor]:
        """The rows `chosen`, on increments from the base. Raises what the factors raise."""

    def native(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.NonlinearFactor]:
        """The rows `chosen` as GTSAM's own factors."""


def members(graph: gtsam.NonlinearFactorGraph) -> list[gtsam.NonlinearFactor]:
    """The factors of a graph."""
    return [graph.at(i) for i in range(graph.size()) if graph.exists(i)]


@dataclass(frozen=True, eq=False)
class LinearGroup:
    """Linear factors on the variables themselves, which are vectors."""

    factors: GaussianFactors
    linear: ClassVar[bool] = True
    name: ClassVar[str] = "linear factor"

    def __post_init__(self) -> None:
        keys, dims, augmented = self.factors.rows, self.factors.dims, self.factors.augmented
        shape = (len(keys), sum(dims) + 1)
        if keys.shape != (len(keys), len(dims)) or augmented.shape[:2] != shape or augmented.dtype != np.float64:
            raise GraphError(f"{self.name}: expected arrays of {shape}, got {keys.shape} and {augmented.shape}")
        usable = (np.abs(augmented) <= LARGEST_INCREMENT).all(axis=(1, 2))
        if not usable.all():
            expected = f"expected finite numbers, at most {LARGEST_INCREMENT:g} standard deviations"
            raise GraphError(f"{self.name} on {format_keys(keys[np.argmin(usable)])}: {expected}")

    @cached_property
    def rows(self) -> Rows:
        return tuple(map(tuple, self.factors.rows.tolist()))

    @property
    def types(self) -> tuple[Variable, ...]:
        return tuple(map(Vector, self.factors.dims))

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
class PriorGroup(LinearGroup):
    """A prior left by marginalised variables: a linear factor on increments from the base."""

    name: ClassVar[str] = "marginal"

    def linearised(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.JacobianFactor]:
        return self.factors.native(chosen=chosen.tolist())

    def here(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.JacobianFactor]:
        """Factors on increments from the linearisation point."""
        augmented = self.factors.augmented.copy()
        for row in chosen.tolist():
            keys, start = self.rows[row], 0
            augmented[row, -1] -= np.concatenate([point.increment(key) for key in keys]) @ augmented[row, :-1]
            for key, dim in zip(keys, self.factors.dims, strict=True):
                columns, D = slice(start, start + dim), point.transport(key)
                if D is not None:
                    augmented[row, columns] = np.linalg.inv(D).T @ augmented[row, columns]
                start += dim
        return replace(self.factors, augmented=augmented).native(chosen=chosen.tolist())

    def error(self, chosen: IntArray, point: LinearisationPoint) -> float:
        """The cost, -log phi, of the rows `chosen` together."""
        return 0.5 * sum(float(np.sum(f.augmentedJacobian()[:, -1] ** 2)) for f in self.here(chosen, point))

    def native(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.NonlinearFactor]:
        return members(nonlinear_graph_at(self.linearised(chosen, point), point.base))


@dataclass(frozen=True, eq=False)
class ResidualGroup:
    """Nonlinear factors of one shape, linearised together."""

    factors: ResidualFactors
    linear: ClassVar[bool] = False

    @cached_property
    def rows(self) -> Rows:
        return tuple(map(tuple, self.factors.rows.tolist()))

    @property
    def name(self) -> str:
        return self.factors.name

    @property
    def types(self) -> tuple[Variable, ...]:
        return self.factors.types

    def linearised(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.JacobianFactor]:
        W, jacobians, residuals = self.factors.linearisation(point.values, chosen)
        keys, rhs, blocks = self.factors.rows[chosen], -residuals, jacobians
        if point.base is not point.values:
            blocks = []
            for k, J in enumerate(jacobians):
                column = keys[:, k].tolist()
                delta = np.stack([point.increment(key) for key in column])
                D = [point.transport(key) for key in column]
                if any(one is not None for one in D):
                    J = np.stack([a if d is None else a @ d for a, d in zip(J, D, strict=True)])
                rhs = rhs + (J @ delta[:, :, None])[:, :, 0]
                blocks.append(J)
        largest = np.abs(W).max(initial=0.0) * max(np.abs(numbers).max(initial=0.0) for numbers in (rhs, *blocks))
        if not largest <= LARGEST_INCREMENT:
            raise FactorError(f"expected a residual and Jacobians of at most {LARGEST_INCREMENT:g} standard deviations")
        return whitened_factors(keys, W, blocks, rhs).native()

    def error(self, chosen: IntArray, point: LinearisationPoint) -> float:
        """The cost, -log phi, of the rows `chosen` together."""
        return float(self.factors.errors(point.values, chosen).sum())

    def native(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.NonlinearFactor]:
        return list(self.factors.custom_factors(chosen.tolist()))


@dataclass(frozen=True, eq=False)
class NativeGroup:
    """One of GTSAM's nonlinear factors."""

    factor: gtsam.NonlinearFactor
    rows: Rows
    name: str
    linear: ClassVar[bool] = False

    @property
    def types(self) -> tuple[Variable, ...] | None:
        """Types of the variables of factors on vectors, whose lengths GTSAM does not check; None for others."""
        if isinstance(self.factor, gtsam.PriorFactorVector):
            return (Vector(len(self.factor.prior())),)
        if isinstance(self.factor, gtsam.BetweenFactorVector):
            return (Vector(len(self.factor.measured())),) * 2
        return None

    def linearised(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.JacobianFactor]:
        made = self.factor.linearize(point.values)
        return [point.from_base(list(made.keys()), made.augmentedJacobian())]

    def native(self, chosen: IntArray, point: LinearisationPoint) -> list[gtsam.NonlinearFactor]:
        return [self.factor]


@dataclass(frozen=True, eq=False)
class ActiveRows:
    """The rows of a group that are still there, for `factors.solve`."""

    group: PriorGroup | ResidualGroup
    chosen: IntArray
    point: LinearisationPoint

    @property
    def keys(self) -> tuple[int, ...]:
        return tuple({key for row in self.chosen.tolist() for key in self.group.rows[row]})

    def error(self, values: gtsam.Values) -> float:
        return self.group.error(self.chosen, LinearisationPoint(self.point.variables, self.point.base, values))

    def linearise(self, values: gtsam.Values) -> gtsam.GaussianFactorGraph:
        if isinstance(self.group, PriorGroup):
            there = LinearisationPoint(self.point.variables, self.point.base, values)
            return gaussian_graph(self.group.here(self.chosen, there))
        there = LinearisationPoint(self.point.variables, values, values)
        return gaussian_graph(self.group.linearised(self.chosen, there))


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
        group = self.factors
        alone = all(len(keys) == 1 for keys in group.rows)
        sharpest = (
            float(np.abs(group.factors.augmented[:, :-1]).max(initial=0.0)) if isinstance(group, LinearGroup) else 0.0
        )
        return isinstance(group, PriorGroup), alone, -sharpest


class FactorIndex:
    """Groups of factors, each with a number that no other group ever has.

    groups  by number
    fresh   groups that were linearised when they were added, and where all variables still are
    """

    def __init__(self) -> None:
        self.groups: dict[int, HeldGroup] = {}
        self.fresh: dict[int, list[gtsam.JacobianFactor]] = {}
        self._named: dict[tuple[str, Hashable], tuple[int, ...]] = {}  # by provider and name
        self._touching: dict[int, Mapping[int, int]] = {}  # of each variable: groups, and how many of their rows
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
        self._touching |= {key: {} for key in keys}

    def remove_variable(self, key: int) -> None:
        """Remove a variable that no factor is on."""
        del self._touching[key]

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
        self._count_rows(number, held.rows.tolist(), 1)
        if held.name is not None:
            self._named[held.provider, held.name] = (*self.named(held.provider, held.name), number)

    def remove(self, number: int) -> None:
        """Remove a group."""
        self.deactivate(number, self.groups[number].rows.tolist())

    def deactivate(self, number: int, rows: list[int]) -> None:
        """Take rows out of a group, and the group with its last one."""
        self.fresh.pop(number, None)
        self._count_rows(number, rows, -1)
        held, self._components = self.groups[number], None
        active = held.active.copy()
        active[rows] = False
        self.groups[number] = replace(held, active=active)
        if active.any():
            return
        del self.groups[number]
        if held.name is not None:
            rest = tuple(n for n in self._named.pop((held.provider, held.name)) if n != number)
            if rest:
                self._named[held.provider, held.name] = rest

    def named(self, provider: str, name: Hashable) -> tuple[int, ...]:
        """Numbers of the groups that a provider gave under a name."""
        return self._named.get((provider, name), ())

    def touching(self, key: int) -> Iterable[int]:
        """Numbers of the groups with a factor on a variable."""
        return self._touching[key]

    def without_factors(self) -> list[int]:
        """Variables without any factor."""
        return [key for key, groups in self._touching.items() if not groups]

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
            result[number] = [row for row in held.rows.tolist() if any(key in keys for key in held.factors.rows[row])]
        return result

    def sharpest_first(self) -> list[HeldGroup]:
        """All groups in the order in which elimination loses the fewest digits."""
        return sorted(self.groups.values(), key=lambda held: held.elimination_order)

    def _count_rows(self, number: int, rows: list[int], step: int) -> None:
        """Count rows of a group on their variables; counts are exchanged, never changed: copies share them."""
        rows_of = self.groups[number].factors.rows
        for key in (key for row in rows for key in rows_of[row]):
            counts = {**self._touching[key], number: self._touching[key].get(number, 0) + step}
            self._touching[key] = {n: count for n, count in counts.items() if count}

"""Index of the factors of a graph: their groups by number and name, and the groups on each variable."""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterable, Mapping
from dataclasses import replace

import gtsam
import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from saga_fg.graph.factor_groups import FactorGroup, HeldGroup


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

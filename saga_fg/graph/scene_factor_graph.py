"""The running graph: variables over time, factors on them, and what marginalised variables leave.

    minimise over x   sum_i rho_i( || r_i(x) ||_{R_i} )

Objects, the vehicle and landmarks are variables of one graph, interactions, measurements and priors its factors. What
leaves is marginalised with all factors on it, linearised where everything is then,

    phi(x_b) = max over x_a of prod phi(x_a, x_b)      a: what leaves, b: its neighbours that stay

so that its information on the rest is kept. The graph holds values and factors, no solver, and can be pickled if its
factors can (a `gtsam.CustomFactor` and a lambda cannot).

Condensation: nonlinear factors in place of the linear prior that marginalised variables leave.

The prior is linear in increments from the linearisation point, and valid near it only. A closed submap moves by metres
as a whole when a loop closes; its factors have to move with it.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Collection, Hashable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Protocol, get_args

import gtsam
import numpy as np

from factors import FactorError, Solution, SolverSettings, Vector, marginal_factors, solve
from factors.gaussian import Elimination
from saga_fg.errors import require_type
from saga_fg.graph.factor_checks import (
    Factor,
    check_variables,
    factor_error,
    grouped,
    solver_error,
    stacked,
)
from saga_fg.graph.factor_groups import (
    ActiveRows,
    FactorEntry,
    FactorIndex,
    HeldGroup,
    LinearGroup,
    PriorGroup,
    ResidualGroup,
)
from saga_fg.graph.variables import (
    GraphError,
    GraphVariable,
    LinearisationPoint,
    NewVariable,
    VariableKind,
    described,
    insert_state,
    key_of,
    variable_type,
)
from saga_fg.numerics import FloatArray, IntArray


class Condensation(Protocol):
    """Makes factors of the marginal that eliminated variables leave; `name` is their provider's, and theirs."""

    @property
    def name(self) -> str: ...

    def factors(self, marginal: Sequence[gtsam.JacobianFactor], point: LinearisationPoint) -> Sequence[Factor]:
        """Return factors in place of the marginal, which is on increments from the base, linearised at `point`."""


_MARGINALS = "marginals"
_RECORDED = (LinearGroup, ResidualGroup)  # groups that are values
WIDE = 256  # dimensions that hang together, from which Cholesky, with half the digits, takes half as long as QR


class SceneFactorGraph:
    """Variables, factors and values. Every method raises `GraphError` and then has changed nothing.

    elimination: of back ends, "qr" or "cholesky", until priors are left that choose; index: of the factors
    """

    def __init__(self, elimination: Elimination = "qr") -> None:
        self._variables: dict[int, GraphVariable] = {}
        self._base, self._values = gtsam.Values(), gtsam.Values()
        self.index = FactorIndex()
        self.elimination: Elimination = elimination
        self.epoch, self.time, self.previous_time = -1, -math.inf, -math.inf
        self.births: dict[int, int] = {}  # when each variable was added: one that comes back is another
        self._added = 0
        self._newest: tuple[int, ...] = ()
        self.carried_over: Mapping[int, int] = {}  # variables of earlier epochs that are those of this one, too

    @property
    def variables(self) -> Mapping[int, GraphVariable]:
        """All variables by key."""
        return MappingProxyType(self._variables)

    @property
    def groups(self) -> Mapping[int, HeldGroup]:
        """All factors, by the number of their group, which no other group ever has."""
        return MappingProxyType(self.index.groups)

    @property
    def values(self) -> gtsam.Values:
        """A copy of where all variables are."""
        return gtsam.Values(self._values)

    @property
    def base(self) -> gtsam.Values:
        """A copy of the base of all variables, from which back ends count increments."""
        return gtsam.Values(self._base)

    def state(self, key: int) -> Any:
        """Value of a variable: a vector, a pose, or as its type reads it."""
        return self.variable(key).type.read(self._values, key)

    def variable(self, key: int) -> GraphVariable:
        """The variable of a key."""
        if key not in self._variables:
            raise GraphError(f"{described(key) if isinstance(key, int) else repr(key)} is not in the graph")
        return self._variables[key]

    def factors(self) -> Iterator[FactorEntry]:
        """Describe every factor."""
        for held in self.index.groups.values():
            for row in held.rows.tolist():
                mine = tuple(self._variables[key] for key in held.factors.rows[row])
                yield FactorEntry(held.provider, held.factors.name, mine)

    def advance(self, time: float, carried_over: Iterable[int] = ()) -> int:
        """Begin the next epoch at `time`, s; returns its number. carried_over: variables that are those of it, too."""
        if not math.isfinite(time) or time <= self.time:
            raise GraphError(f"time: expected a finite number after {self.time:.6f} s, got {time!r}")
        self.epoch, self.previous_time, self.time = self.epoch + 1, self.time, float(time)
        its = ((self._variables[key], key) for key in carried_over)
        self.carried_over = {key_of(one.kind, one.id, self.epoch): key for one, key in its}
        self._newest = ()
        return self.epoch

    @property
    def static(self) -> list[int]:
        """Keys of the variables for all time."""
        return [key for key, one in self._variables.items() if one.epoch is None]

    @property
    def newest(self) -> list[int]:
        """Keys of the variables of this epoch."""
        return [key for key in self._newest if key in self._variables]

    def add_variables(
        self, provider: str, variables: Iterable[NewVariable], when: tuple[int, float] | None = None
    ) -> list[int]:
        """Add variables, of the present epoch or `when` (number, s) where they are not static; returns their keys."""
        added: dict[int, GraphVariable] = {}
        values = gtsam.Values()
        for new in variables:
            if not isinstance(new, NewVariable):
                raise GraphError(f"provider {provider}: expected NewVariable, got {type(new).__name__}")
            if self.epoch < 0:
                raise GraphError(f"provider {provider}: expected an epoch before variables: advance(time)")
            if not isinstance(new.kind, VariableKind):
                raise GraphError(f"provider {provider}: expected a VariableKind, got {type(new.kind).__name__}")
            epoch, time = (None, None) if new.static else when or (self.epoch, self.time)
            key = key_of(new.kind, new.id, epoch)
            kind = new.type or variable_type(f"provider {provider}: {new.kind.name} {new.id}", new.state)
            variable = GraphVariable(key, new.kind, int(new.id), epoch, time, kind, new.label or new.kind.name)
            if key in self._variables or key in added:
                raise GraphError(
                    f"provider {provider}: {variable}: expected a new variable, it is in the graph already"
                )
            try:
                insert_state(values, variable, new.state)
            except GraphError as error:
                raise GraphError(f"provider {provider}: {error}") from error
            added[key] = variable
        self._variables |= added
        self._added += 1
        self.births |= dict.fromkeys(added, self._added)
        self._newest += tuple(key for key, one in added.items() if one.epoch == self.epoch)
        self._values.insert(values)
        self._base.insert(values)
        self.index.add_variables(added)
        return list(added)

    def add_factors(
        self, provider: str, factors: Iterable[Factor] | gtsam.NonlinearFactorGraph, name: Hashable = None
    ) -> None:
        """Add factors; under a `name`, in place of those that this provider gave under it before.

        Each is linearised where its variables are, so that one that cannot be is refused.
        """
        groups = grouped(provider, factors, self._variables)
        held = [HeldGroup(provider, name, group, np.ones(len(group.rows), dtype=bool)) for group in groups]
        point = self.point()
        linear = [self.linearised(one, one.rows, point) for one in held]
        if name is not None:
            for number in self.index.named(provider, name):
                self.index.remove(number)
        for one, factors_there in zip(held, linear, strict=True):
            if len(one.active):
                self.index.fresh[self.index.add(one)] = factors_there

    def marginalise(self, keys: Iterable[int], into: Condensation | None = None) -> None:
        """Integrate variables out; their information on the others stays, in the factors that `into` makes of it."""
        leaving = {key: self.variable(key) for key in keys}
        if not leaving:
            return
        touched, point, rows = gtsam.GaussianFactorGraph(), self.point(), self.index.rows_on(leaving)
        for number, mine in rows.items():
            for factor in self.linearised(self.index.groups[number], np.array(mine), point):
                touched.push_back(factor)
        eliminated = sorted(leaving.keys() & set(touched.keyVector()))
        if into is not None:
            made = into.factors(self._eliminated(touched, eliminated, "qr"), point)
            self.replace_rows(rows, [], leaving)
            self.add_factors(into.name, made)
            return
        self.replace_rows(rows, self._eliminated(touched, eliminated, self.elimination), leaving)

    def drop(self, keys: Set[int]) -> None:
        """Take out variables with all factors on them, which are on no others: whole components."""
        self.replace_rows(self.index.rows_on(keys), [], keys)

    def replace_rows(
        self, rows: Mapping[int, list[int]], factors: Sequence[gtsam.JacobianFactor], leaving: Iterable[int]
    ) -> list[int]:
        """Put priors, on increments from the base, in place of rows of groups and of the variables `leaving`.

        They are all rows on these. Returns the numbers of the priors' groups, one each.
        """
        priors = [PriorGroup(stacked([factor], self.point().dims(factor.keys()))) for factor in factors]
        for number, mine in rows.items():
            self.index.deactivate(number, mine)
        added = [self.index.add(HeldGroup(_MARGINALS, None, prior, np.ones(1, dtype=bool))) for prior in priors]
        for key in leaving:
            del self._variables[key], self.births[key]
            self.index.remove_variable(key)
            self._values.erase(key)
            self._base.erase(key)
        if factors:
            self._choose(max(factor.cols() - 1 for factor in factors))
        return added

    def replace_by_prior(self, leaving: Collection[int], prior: gtsam.JacobianFactor) -> None:
        """Put a prior, on increments from the base, in place of all factors on its variables and those `leaving`."""
        self.replace_rows(self.index.rows_on({*leaving, *prior.keys()}), [prior], leaving)

    def independent(self, keys: Set[int]) -> bool:
        """Whether all factors on some variables are linear, and priors alone tie them to other variables."""
        for number, mine in self.index.rows_on(keys).items():
            group = self.index.groups[number].factors
            shared = not isinstance(group, PriorGroup) and any(not keys >= set(group.rows[row]) for row in mine)
            if shared or not group.linear:
                return False
        return True

    def of(self, kind: VariableKind, epoch: int | None) -> dict[int, GraphVariable]:
        """The variables of a kind and an epoch, None for those for all time, by id."""
        carried_over = set(self.carried_over.values()) if epoch == self.epoch else ()
        every = (one for one in self._variables.values() if one.epoch == epoch or one.key in carried_over)
        return {one.id: one for one in every if one.kind == kind}

    def older_than(self, time: float) -> list[int]:
        """Keys of the variables of epochs before `time`."""
        return [key for key, one in self._variables.items() if one.time is not None and one.time < time]

    def point(self) -> LinearisationPoint:
        """The present values as a linearisation point."""
        return LinearisationPoint(self._variables, self._base, self._values)

    def linearised(self, held: HeldGroup, rows: IntArray, point: LinearisationPoint) -> list[gtsam.JacobianFactor]:
        """Rows of a group as linear factors on increments from the base."""
        try:
            return held.factors.linearised(rows, point)
        except Exception as error:
            raise factor_error(self._variables, held, rows, error) from error

    def moved_to(self, values: gtsam.Values) -> None:
        """Put the variables where a back end has found them; the graph takes the values over."""
        self._values = values
        self.index.fresh.clear()

    def linear(self, number: int, point: LinearisationPoint) -> list[gtsam.JacobianFactor]:
        """Active factors of a group, linear, on increments from the base."""
        if number in self.index.fresh:
            return self.index.fresh[number]
        held = self.groups[number]
        return self.linearised(held, held.rows, point)

    def solve(self, settings: SolverSettings | None = None) -> Solution:
        """Minimise over everything by Levenberg-Marquardt, and put the variables there."""
        native, ours = self.solver_inputs()
        try:
            solution = solve(native, ours, self._values, settings)
        except FactorError as error:
            raise solver_error(self._variables, self.index.groups, error) from error
        self.moved_to(gtsam.Values(solution.values))
        return solution

    def solver_inputs(
        self, part: Iterable[tuple[HeldGroup, IntArray]] | None = None
    ) -> tuple[gtsam.NonlinearFactorGraph, list[ActiveRows]]:
        """Factors for `factors.solve`: GTSAM's own, and those that are linearised in NumPy.

        part: groups with their rows, the sharpest first, by default all
        """
        native, ours, point = gtsam.NonlinearFactorGraph(), list[ActiveRows](), self.point()
        for held, rows in ((held, held.rows) for held in self.index.sharpest_first()) if part is None else part:
            if isinstance(held.factors, PriorGroup | ResidualGroup):
                ours.append(ActiveRows(held.factors, rows, point))
            else:
                for factor in held.factors.native(rows, point):
                    native.add(factor)
        return native, ours

    def native(self) -> gtsam.NonlinearFactorGraph:
        """All factors as GTSAM's own, for its solvers from `values`; ours call back into Python, which is slow."""
        graph, point = gtsam.NonlinearFactorGraph(), self.point()
        for held in self.index.groups.values():
            for factor in held.factors.native(held.rows, point):
                graph.add(factor)
        return graph

    def copy(self) -> SceneFactorGraph:
        """A graph of its own with the same variables and factors, which are shared."""
        other = SceneFactorGraph()
        other.__dict__ |= self.__dict__
        other._variables, other.index, other.births = dict(self._variables), self.index.copy(), dict(self.births)
        other._base, other._values = self.base, self.values
        return other

    def _eliminated(
        self, touched: gtsam.GaussianFactorGraph, keys: list[int], elimination: Elimination
    ) -> list[gtsam.JacobianFactor]:
        """Factors that are left on the other variables."""
        if elimination == "cholesky":
            with contextlib.suppress(FactorError, RuntimeError):  # it has half the digits that QR has
                return _jacobians(marginal_factors(touched, keys, "cholesky"))
        try:
            return _jacobians(marginal_factors(touched, keys, "qr"))
        except FactorError as error:
            raise solver_error(self._variables, self.index.groups, error) from error

    def _choose(self, widest: int) -> None:
        """QR where what is left of marginalised variables is on few dimensions together, else Cholesky."""
        if widest > WIDE:
            self.elimination = "cholesky"
        elif widest < WIDE // 2:
            self.elimination = "qr"


def _jacobians(graph: gtsam.GaussianFactorGraph) -> list[gtsam.JacobianFactor]:
    every = [graph.at(i) for i in range(graph.size()) if graph.at(i).size()]
    return [one if isinstance(one, gtsam.JacobianFactor) else gtsam.JacobianFactor(one) for one in every]


@dataclass(frozen=True, eq=False)
class GraphRecord:
    """A graph of vectors as plain values, which a file can hold: what it takes to go on from there.

    base, values: of the variables, in their order; groups: by number, of which `count` have been; births: when each
    variable was added, of `additions`
    """

    elimination: Elimination
    epoch: int
    time: float
    previous_time: float
    variables: tuple[GraphVariable, ...]
    base: tuple[FloatArray, ...]
    values: tuple[FloatArray, ...]
    births: tuple[int, ...]
    additions: int
    groups: Mapping[int, HeldGroup]
    count: int
    newest: tuple[int, ...]
    carried_over: Mapping[int, int]

    @staticmethod
    def from_graph(graph: SceneFactorGraph) -> GraphRecord:
        """The record of a graph. Raises `GraphError` for poses and for factors that are more than arrays."""
        variables, point, groups = tuple(graph.variables.values()), graph.point(), dict(graph.groups)
        for one in variables:
            if not isinstance(one.type, Vector):
                raise GraphError(f"{one}: expected a vector: poses can't be written to a file")
        for held in groups.values():
            if not isinstance(held.factors, _RECORDED):
                raise GraphError(f"provider {held.provider}: {held.factors.name}: it can't be written to a file")
        return GraphRecord(
            elimination=graph.elimination,
            epoch=graph.epoch,
            time=graph.time,
            previous_time=graph.previous_time,
            variables=variables,
            base=tuple(one.type.read(point.base, one.key) for one in variables),
            values=tuple(one.type.read(point.values, one.key) for one in variables),
            births=tuple(graph.births[one.key] for one in variables),
            additions=graph._added,
            groups=groups,
            count=graph.index.count,
            newest=graph._newest,
            carried_over=graph.carried_over,
        )

    def restored(self) -> SceneFactorGraph:
        """The graph. Raises `GraphError` where the parts don't fit together."""
        if self.elimination not in get_args(Elimination):
            raise GraphError(f"elimination: expected one of {get_args(Elimination)}, got {self.elimination!r}")
        graph = SceneFactorGraph(self.elimination)
        for one, base, value, born in zip(self.variables, self.base, self.values, self.births, strict=True):
            if one.key != key_of(one.kind, one.id, one.epoch) or one.key in graph._variables:
                raise GraphError(f"{one}: expected a key of its own, of its kind, id and epoch")
            if not isinstance(one.type, Vector):
                raise GraphError(f"{one}: expected a vector, got {one.type}")
            insert_state(graph._base, one, base)
            insert_state(graph._values, one, value)
            graph._variables[one.key], graph.births[one.key] = one, born
        graph.index.add_variables(graph._variables)
        for number, held in sorted(self.groups.items()):
            require_type("group", held, HeldGroup)
            if not isinstance(held.factors, _RECORDED) or len(held.active) != len(held.factors.rows):
                raise GraphError(f"factors of {held.provider}: expected arrays, one truth value a row")
            check_variables(held.provider, held.factors, held.rows.tolist(), graph._variables)
            graph.index.put(number, held)
        graph.index.count = max(self.count, graph.index.count)
        graph.epoch, graph.time, graph.previous_time = self.epoch, self.time, self.previous_time
        graph._added, graph._newest, graph.carried_over = self.additions, tuple(self.newest), dict(self.carried_over)
        return graph

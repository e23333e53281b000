"""Factor providers: the sources of variables and factors of a running graph.

Once a frame each provider is asked, in the order given, what it adds: new variables, with where they are to begin with,
and factors. What it sees is a `GraphView`, which it can read and not change; those asked after it see what it added.

    class WallDistance:
        name = "wall"

        def factors(self, view):
            rows = [[car.key] for car in view.now(OBJECT).values()]
            return Additions(factors=[ResidualFactors(rows, (4,), lambda x: x[:, 1:2] - 3.0, [[0.25]])])

What goes on from epoch to epoch (a pose, a bias) is added by a method `predict(view)` that a provider may have as well:
it is asked when an epoch begins, while the variables of the epoch before are still there, and before all `factors`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import gtsam
import numpy as np

from saga_fg.graph.factor_checks import Factor, each_factor, mentioned_keys, with_names
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.graph.variables import GraphError, GraphVariable, NewVariable, ProviderError, VariableKind, key_of
from saga_fg.numerics import FloatArray
from saga_fg.parts import part_kind
from saga_fg.types import Frame

Factors = Sequence[Factor] | gtsam.NonlinearFactorGraph


@dataclass(frozen=True, eq=False)
class Additions:
    """Additions of a provider to the graph.

    variables   new ones, of this epoch or for all time
    factors     on variables of the graph, new ones among them
    named       factors in place of those that the same provider gave under the same name before; none: take them out
    """

    variables: Sequence[NewVariable] = ()
    factors: Factors = ()
    named: Mapping[Hashable, Factors] = field(default_factory=dict)


@part_kind("factor provider", "saga_fg.providers")
class FactorProvider(Protocol):
    """Anything that adds factors; `name` is for messages."""

    @property
    def name(self) -> str: ...

    def factors(self, view: GraphView) -> Additions:
        """Return the additions of this epoch."""


class OtherVariables(Protocol):
    """Variables that a back end holds apart from the graph, until a provider's factor is on them."""

    @property
    def variables(self) -> Mapping[int, GraphVariable]:
        """All of them by key."""

    def of(self, kind: VariableKind, epoch: int) -> dict[int, GraphVariable]:
        """The variables of a kind and an epoch, by id."""

    def state(self, key: int) -> Any:
        """Value of one of them."""

    def covariance(self, key: int) -> FloatArray:
        """Its marginal covariance (d, d)."""

    def add_to(self, graph: SceneFactorGraph, keys: Collection[int]) -> None:
        """Put those among `keys` into the graph, with their factors."""


class GraphView:
    """The graph at the present epoch, to read.

    covariance(key): marginal (d, d), as known before this frame; origin (2,): that positions of objects are counted
    from, in the world, m (a tracker's is near its first frame, so that no digits are lost), places of the vehicle and
    of landmarks as well; frame: what the epoch brings, None where none was given
    """

    def __init__(
        self,
        graph: SceneFactorGraph,
        covariance: Callable[[int], FloatArray],
        origin: FloatArray,
        frame: Frame | None = None,
        others: OtherVariables | None = None,
    ) -> None:
        self._graph, self._covariance, self.origin, self.frame = graph, covariance, origin.copy(), frame
        self._others = others
        self.origin.setflags(write=False)

    @property
    def epoch(self) -> int:
        """The number of the present epoch."""
        return self._graph.epoch

    @property
    def time(self) -> float:
        """Its time, s."""
        return self._graph.time

    @property
    def dt(self) -> float:
        """Time since the epoch before, s; 0 for the first one."""
        return self.time - self._graph.previous_time if self.epoch > 0 else 0.0

    @property
    def variables(self) -> Mapping[int, GraphVariable]:
        """All variables by key."""
        return self._graph.variables if self._others is None else {**self._others.variables, **self._graph.variables}

    def now(self, kind: VariableKind) -> dict[int, GraphVariable]:
        """The variables of a kind at this epoch, by id."""
        return self._of(kind, self.epoch)

    def before(self, kind: VariableKind) -> dict[int, GraphVariable]:
        """The variables of a kind at the epoch before, by id."""
        return self._of(kind, self.epoch - 1)

    def static(self, kind: VariableKind) -> dict[int, GraphVariable]:
        """The variables of a kind for all time, by id."""
        return self._graph.of(kind, None)

    def key(self, kind: VariableKind, id: int, static: bool = False) -> int:  # noqa: A002 -- an id is what it is
        """The key of a variable of this epoch, or of one for all time; whether it is there or only to be added."""
        key = key_of(kind, id, None if static else self.epoch)
        return self._graph.carried_over.get(key, key)

    def state(self, key: int) -> Any:
        """Value of a variable."""
        return (
            self._graph.state(key) if self._others is None or key in self._graph.variables else self._others.state(key)
        )

    def covariance(self, key: int) -> FloatArray:
        """Marginal covariance (d, d) of a variable, as known before this frame."""
        if self._others is not None and key not in self._graph.variables:
            return self._others.covariance(key)
        self._graph.variable(key)
        return self._covariance(key)

    def take_in(self, keys: Collection[int]) -> None:
        """Have those variables in the graph that a back end holds apart from it; a provider's factors are on `keys`."""
        if self._others is not None and (apart := set(keys) - self._graph.variables.keys()):
            self._others.add_to(self._graph, apart)

    def _of(self, kind: VariableKind, epoch: int) -> dict[int, GraphVariable]:
        mine = self._graph.of(kind, epoch)
        if self._others is not None:
            mine |= self._others.of(kind, epoch)
        return dict(sorted(mine.items()))


def ask_all(providers: Iterable[FactorProvider], graph: SceneFactorGraph, frame: Frame | None = None) -> None:
    """Add what providers give at the present epoch of a recording that is solved as a whole; frame: of that epoch."""
    view, asked = GraphView(graph, _unknown, np.zeros(2), frame), list(providers)
    for provider in (*predictors(asked), *asked):
        ask(provider, graph, view)


def _unknown(key: int) -> FloatArray:
    raise GraphError("covariance: a recording is solved as a whole, no marginal is known before")


@dataclass(frozen=True, eq=False)
class _Predictor:
    """The `predict` of a provider, as a provider."""

    provider: Any

    @property
    def name(self) -> str:
        return _name(self.provider)

    def factors(self, view: GraphView) -> Additions:
        added: Additions = self.provider.predict(view)
        return added


def predictors(providers: Iterable[FactorProvider]) -> list[FactorProvider]:
    """Select the providers with a `predict`, which is called when an epoch begins."""
    return [_Predictor(provider) for provider in providers if callable(getattr(provider, "predict", None))]


def ask(provider: FactorProvider, graph: SceneFactorGraph, view: GraphView) -> None:
    """Add what a provider gives.

    Raises `ProviderError` that names it, `GraphError` for one of an estimator's own (`internal`); some of it may have
    been added then.
    """
    name = _name(provider)
    try:
        _ask(name, provider, graph, view)
    except Exception as error:
        expected = isinstance(error, GraphError | ValueError)
        text = " ".join((str(error) if expected else repr(error)).split()).removeprefix(f"provider {name}: ")
        kind = GraphError if getattr(provider, "internal", False) else ProviderError
        raise kind(f"provider {name}: {with_names(graph.variables, text, graph.variables)[:500]}") from error


def _ask(name: str, provider: FactorProvider, graph: SceneFactorGraph, view: GraphView) -> None:
    additions = provider.factors(view)
    if not isinstance(additions, Additions):
        raise GraphError(f"provider {name}: expected Additions, got {type(additions).__name__}")
    _checked(name, "variables", additions.variables)
    known = [one for one in additions.variables if isinstance(one, NewVariable) and isinstance(one.kind, VariableKind)]
    view.take_in([key_of(one.kind, one.id, None if one.static else view.epoch) for one in known])
    graph.add_variables(name, additions.variables)
    _add(name, additions.factors, None, graph, view)
    if not isinstance(additions.named, Mapping):
        raise GraphError(f"provider {name}: named: expected factors by name, got {type(additions.named).__name__}")
    for key, factors in additions.named.items():
        _add(name, factors, key, graph, view)


def _add(provider: str, factors: Any, name: Hashable, graph: SceneFactorGraph, view: GraphView) -> None:
    given = each_factor(provider, factors)
    view.take_in(mentioned_keys(given))
    graph.add_factors(provider, given, name)


def _name(provider: Any) -> str:
    return str(getattr(provider, "name", type(provider).__name__))


def _checked(name: str, what: str, value: Any) -> None:
    if isinstance(value, str | bytes) or not isinstance(value, Iterable):
        raise GraphError(f"provider {name}: {what}: expected a list, got {type(value).__name__}")

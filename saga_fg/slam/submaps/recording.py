"""Record of providers' additions by epoch, replayed when the whole drive is solved at once."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from saga_fg.graph import Additions, FactorProvider, GraphView


@dataclass(frozen=True, eq=False)
class Given:
    """Provider of what is known already."""

    added: Additions
    name: str

    def factors(self, view: GraphView) -> Additions:
        return self.added


@dataclass(eq=False)
class Recorded:
    """A provider whose additions are kept, by epoch."""

    provider: FactorProvider
    additions: dict[int, list[Additions]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        return str(getattr(self.provider, "name", type(self.provider).__name__))

    def factors(self, view: GraphView) -> Additions:
        return self._kept(view, self.provider.factors(view))

    def again(self, epoch: int) -> list[FactorProvider]:
        """Providers of what this one gave at an epoch."""
        return [Given(one, self.name) for one in self.additions.get(epoch, ())]

    def _kept(self, view: GraphView, added: Additions) -> Additions:
        if isinstance(added, Additions) and (added.variables or len(_list(added.factors)) or added.named):
            self.additions.setdefault(view.epoch, []).append(added)
        return added


@dataclass(eq=False)
class RecordedPredictor(Recorded):
    """One with a `predict`."""

    def predict(self, view: GraphView) -> Additions:
        predict: Any = self.provider
        return self._kept(view, predict.predict(view))


def recorded(providers: Iterable[FactorProvider]) -> list[Recorded]:
    """Wrap providers."""
    return [
        (RecordedPredictor if callable(getattr(provider, "predict", None)) else Recorded)(provider)
        for provider in providers
    ]


def _list(factors: Any) -> Sequence[Any]:
    return factors if isinstance(factors, Sequence) else [factors]

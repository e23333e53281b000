"""The exceptions of the running graph: each names the provider, the kind of factor and the variables concerned."""

from __future__ import annotations

from saga_fg.errors import InputError


class GraphError(InputError):
    """A variable or factor that the graph does not take; the graph is as it was before."""


class ProviderError(GraphError):
    """A provider of a user's raised, or gave what the graph does not take."""


class UndeterminedError(GraphError):
    """The factors leave variables undetermined; `keys` are these variables, as far as they could be found."""

    def __init__(self, message: str, keys: tuple[int, ...] = ()) -> None:
        super().__init__(message)
        self.keys = keys

    def __reduce__(self) -> tuple[type[UndeterminedError], tuple[str, tuple[int, ...]]]:
        return type(self), (str(self), self.keys)

"""The exceptions of saga-fg. Everything a caller can cause by what he passes in is a `SagaError`."""

from collections.abc import Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from importlib.util import find_spec


class SagaError(Exception):
    """Base of all exceptions raised on purpose by saga-fg; its text is one line meant for people."""


class InputError(SagaError, ValueError):
    """A value, file or record is not what was expected; the text names where, which field, and what was expected."""


def require_type(name: str, value: object, *types: type) -> None:
    """Raise `InputError` unless `value` is an instance of one of `types`."""
    if not isinstance(value, types):
        wanted = " or ".join(each.__name__ for each in types)
        raise InputError(f"{name}: expected {wanted}, got {type(value).__name__}")


class UnknownNodeError(SagaError, KeyError):
    """A node was named that the estimator or graph does not hold."""

    def __str__(self) -> str:  # KeyError would print the repr of its argument
        return str(self.args[0]) if self.args else ""


class MissingExtraError(SagaError, ImportError):
    """An optional dependency is not installed; the text names the extra that brings it."""


def require_extra(extra: str, what: str, *modules: str) -> None:
    """Raise `MissingExtraError` where a module that something needs is not installed; `extra` brings it."""
    for name in modules:
        if find_spec(name) is None:
            raise MissingExtraError(f"{what} needs {name}: pip install 'saga-fg[{extra}]'")


class KernelError(SagaError, RuntimeError):
    """A kernel cannot be compiled, as Numba is missing or does not fit; the text names the reason."""


@contextmanager
def error_context(where: str) -> Iterator[None]:
    """Prefix every `InputError` of the block with `where`, unless it begins so."""
    try:
        yield
    except InputError as error:
        if str(error).startswith(f"{where}: "):
            raise
        raise InputError(f"{where}: {error}") from error


_LONGEST = 80  # characters of a name that a message shows


def unknown_name(what: str, name: str, known: tuple[str, ...]) -> str:
    """Message about a name that is not among the `known` ones: the nearest of them, and the list if it is short."""
    nearest = get_close_matches(name[:_LONGEST], known, n=1, cutoff=0.6)
    hint = f"; did you mean {nearest[0][:_LONGEST]!r}? Expected" if nearest else ", expected"
    shown = ", ".join(each[:_LONGEST] for each in known[:12]) + (f", ... ({len(known)} in all)" * (len(known) > 12))
    return f"unknown {what} {name[:_LONGEST]!r}{hint} one of: {shown or 'none here'}"

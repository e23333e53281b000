"""The exceptions of saga-fg. Everything a caller can cause by what he passes in is a `SagaError`."""

from __future__ import annotations


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


class KernelError(SagaError, RuntimeError):
    """A kernel cannot be compiled, as Numba is missing or does not fit; the text names the reason."""

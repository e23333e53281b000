"""The exceptions of factors. Whatever a caller can cause by what he passes in is a `FactorError`."""

from __future__ import annotations


class FactorError(ValueError):
    """An argument of a factor is not what was expected; the text names which one and what was expected."""


class SingularSystemError(FactorError):
    """A linear system does not determine all of its variables.

    `keys` are the variables concerned, as far as they could be found; the text names them in GTSAM's notation.
    """

    def __init__(self, message: str, keys: tuple[int, ...] = ()) -> None:
        super().__init__(message)
        self.keys = keys

    def __reduce__(self) -> tuple[type[SingularSystemError], tuple[str, tuple[int, ...]]]:
        return type(self), (str(self), self.keys)

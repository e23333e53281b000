"""Compilation of kernels: functions over arrays that Numba compiles at their first call, and keeps on disk.

Compiled code is kept beside the source, or in the cache folder of the user where that is read-only (`NUMBA_CACHE_DIR`
names another place). Without Numba, or with `NUMBA_DISABLE_JIT=1`, `compiled_kernels` is false: then callers take their
NumPy versions, and kernels are never called.
"""

from __future__ import annotations

import importlib
import importlib.util
import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import update_wrapper
from typing import Any, Generic, ParamSpec, TypeVar, cast

P = ParamSpec("P")
R = TypeVar("R")

log = logging.getLogger(__name__)
_SCALARS = {"f": "float64", "i": "int64", "b": "boolean", "u": "uint32"}
_enabled = importlib.util.find_spec("numba") is not None and os.environ.get("NUMBA_DISABLE_JIT", "0") in ("", "0")
_announced = False


def compiled_kernels() -> bool:
    """True where kernels are used, false where NumPy alone is."""
    return _enabled


@contextmanager
def only_numpy() -> Iterator[None]:
    """Do without kernels, to compare with."""
    global _enabled
    before, _enabled = _enabled, False
    try:
        yield
    finally:
        _enabled = before


class Kernel(Generic[P, R]):
    """A function that is compiled when it is first called; `source` is the function itself."""

    def __init__(self, source: Callable[P, R], arguments: str) -> None:
        self.source = source
        self._arguments = arguments
        self._compiled: Callable[P, R] | None = None
        update_wrapper(self, source)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        if self._compiled is None:
            self._compiled = cast(Callable[P, R], _compiled(self.source, self._arguments))
        return self._compiled(*args, **kwargs)


def kernel(arguments: str) -> Callable[[Callable[P, R]], Kernel[P, R]]:
    """Decorate a function to be compiled for arguments of these kinds, with spaces between.

    f, i, b, u are a float, an integer, a truth value, the code of a character; followed by a digit an array of as
    many dimensions, which is only read, of any strides, or contiguous where a c follows.
    """
    return lambda source: Kernel(source, arguments)


def _compiled(source: Callable[..., Any], arguments: str) -> Any:
    numba: Any = importlib.import_module("numba")  # takes as long as all else that a command imports
    _announce_compilation()
    signature = tuple(_argument(numba.types, kind) for kind in arguments.split())
    options = {"error_model": "numpy", "nogil": True}
    try:
        return numba.njit(signature, cache=True, **options)(source)
    except RuntimeError as error:  # no folder to keep it in
        log.warning("%s: it is compiled anew each time", error)
        return numba.njit(signature, **options)(source)


def _argument(types: Any, kind: str) -> Any:
    scalar = getattr(types, _SCALARS[kind[0]])
    if len(kind) == 1:
        return scalar
    return types.Array(scalar, int(kind[1]), "C" if kind.endswith("c") else "A", readonly=True)


def _announce_compilation() -> None:
    """Say once that kernels are being compiled, which takes seconds, when the first of them is not found on disk."""
    global _announced
    if _announced:
        return
    _announced = True
    event: Any = importlib.import_module("numba.core.event")

    class Announcement(event.Listener):  # type: ignore[misc]
        said = False

        def on_start(self, event: Any) -> None:
            if not self.said:
                self.said = True
                log.warning("compiling kernels, once for this installation: some seconds")

        def on_end(self, event: Any) -> None:
            pass

    event.register("numba:compile", Announcement())

"""Compilation of kernels: functions over arrays that Numba compiles at their first call, and keeps on disk.

Compiled code is kept beside the source, or in the cache folder of the user where that is read-only (`NUMBA_CACHE_DIR`
names another place). With `NUMBA_DISABLE_JIT=1` kernels run as plain Python, without Numba: some hundred times slower,
for tests and for debugging.
"""

from __future__ import annotations

import gc
import importlib
import logging
import os
import pkgutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, update_wrapper
from types import FunctionType
from typing import Any, Generic, ParamSpec, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

import saga_fg.kernels
from saga_fg.errors import KernelError

P = ParamSpec("P")
R = TypeVar("R")

log = logging.getLogger(__name__)
_OPTIONS = {"error_model": "numpy", "nogil": True, "no_cfunc_wrapper": True}
_SCALARS = {"f": "float64", "i": "int64", "b": "boolean", "u": "uint32"}
_kernels: list[Kernel[Any, Any]] = []  # of the modules that were imported
_parts: set[Callable[..., Any]] = set()  # functions that kernels of the same module call
_said: set[str] = set()


def load_kernels() -> None:
    """Load or compile all kernels, so that no frame waits for it."""
    for module in pkgutil.iter_modules(saga_fg.kernels.__path__):
        importlib.import_module(f"saga_fg.kernels.{module.name}")
    for each in _kernels:
        each.load()


class Kernel(Generic[P, R]):
    """A function that is compiled when it is first called; `source` is the function itself.

    Raises `KernelError` where Numba cannot be imported, or does not compile it.
    """

    def __init__(self, source: Callable[P, R], arguments: str) -> None:
        self.source = source
        self._arguments = arguments
        self._compiled: Callable[P, R] | None = None
        update_wrapper(self, source)
        _kernels.append(self)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        return (self._compiled or self.load())(*args, **kwargs)

    def load(self) -> Callable[P, R]:
        """Compile it, or load it from disk, unless that is done."""
        if self._compiled is None:
            if os.environ.get("NUMBA_DISABLE_JIT") == "1":
                self._compiled = self.source
            else:
                with _garbage_uncollected():
                    self._compiled = cast(Callable[P, R], _compiled(self.source, self._arguments))
        return self._compiled


def kernel(arguments: str) -> Callable[[Callable[P, R]], Kernel[P, R]]:
    """Decorate a function to be compiled for arguments of these kinds, with spaces between.

    f, i, b, u are a float, an integer, a truth value, the code of a character; followed by a digit an array of as
    many dimensions, which is only read, of any strides, or contiguous where a c follows.
    """
    return lambda source: Kernel(source, arguments)


def kernel_part(source: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function that kernels of its module call, to be compiled as a part of them."""
    _parts.add(source)
    return source


@contextmanager
def _garbage_uncollected() -> Iterator[None]:
    """Look for no garbage meanwhile: among the millions of objects of a compilation that takes a fifth of its time."""
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()


@cache
def _numba() -> Any:
    try:
        return importlib.import_module("numba")  # takes as long as all else that a command imports
    except Exception as error:  # missing, too old for this NumPy, or a library of it is missing
        raise KernelError(f"Numba cannot be imported: {_in_one_line(error)}; `pip install --upgrade numba`") from error


def _compiled(source: Callable[..., Any], arguments: str) -> Any:
    numba = _numba()
    _announce_compilation()
    signature = tuple(_argument(numba.types, kind) for kind in arguments.split())
    source = _with_compiled_parts(source)
    function = numba.njit(**_OPTIONS)(source)
    for attempt in ("first", "last"):
        try:
            function.enable_caching()
            function.compile(signature)
            break
        except Exception as error:  # no folder to keep it in, a damaged file there, a full disk
            if isinstance(error, numba.core.errors.NumbaError):
                raise _not_compiled(source, error) from error
            folder = function.stats.cache_path or "disk"
            _say_once("kernels cannot be loaded from %s or kept there, and are compiled anew: %s", folder, repr(error))
            if function.signatures:
                break
            if attempt == "last":
                return _compiled_without_disk(source, signature)
            with suppress(Exception):
                function._cache.flush()  # what is damaged is forgotten, and written anew
    function.disable_compile()
    return function


def _compiled_without_disk(source: Callable[..., Any], signature: tuple[Any, ...]) -> Any:
    try:
        return _numba().njit(signature, **_OPTIONS)(source)
    except Exception as error:
        raise _not_compiled(source, error) from error


def _not_compiled(source: Callable[..., Any], error: Exception) -> KernelError:
    numba = _numba()
    return KernelError(
        f"kernel {source.__name__}: Numba {numba.__version__} does not compile it: {_in_one_line(error)}"
    )


def _in_one_line(error: Exception) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)


def _with_compiled_parts(source: Callable[..., Any]) -> Callable[..., Any]:
    """The function with its parts compiled, and theirs."""
    names = [name for name in source.__code__.co_names if source.__globals__.get(name) in _parts]
    if not names:
        return source
    parts = {name: _compiled_part(source.__globals__[name]) for name in names}
    return update_wrapper(FunctionType(source.__code__, source.__globals__ | parts, source.__name__), source)


@cache  # kernels share their parts
def _compiled_part(source: Callable[..., Any]) -> Any:
    return _numba().njit(**_OPTIONS, no_cpython_wrapper=True)(_with_compiled_parts(source))


def _argument(types: Any, kind: str) -> Any:
    scalar = getattr(types, _SCALARS[kind[0]])
    return (
        scalar
        if len(kind) == 1
        else types.Array(scalar, int(kind[1]), "C" if kind.endswith("c") else "A", readonly=True)
    )


def _say_once(message: str, *values: str) -> None:
    if message not in _said:
        _said.add(message)
        log.warning(message, *values)


@cache
def _announce_compilation() -> None:
    """Say once that kernels are being compiled, which takes seconds, when the first of them is not found on disk."""
    event: Any = importlib.import_module("numba.core.event")

    class Announcement(event.Listener):  # type: ignore[misc]
        def on_start(self, event: Any) -> None:
            _say_once("compiling kernels that this installation has not run yet: up to twenty seconds")

        def on_end(self, event: Any) -> None:
            pass

    event.register("numba:compile", Announcement())


FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
StrArray = NDArray[np.str_]
CodeArray = NDArray[np.uint32]  # of characters

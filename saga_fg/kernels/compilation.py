"""Compilation of kernels: functions over arrays that Numba compiles at their first call, and keeps on disk.

Compiled code is kept beside the source, or in the cache folder of the user where that is read-only (`NUMBA_CACHE_DIR`
names another place). Without a Numba that works, or with `NUMBA_DISABLE_JIT=1`, `compiled_kernels` is false: then
callers take their NumPy versions, and kernels are never called.
"""

from __future__ import annotations

import gc
import importlib
import importlib.util
import logging
import os
import pkgutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, update_wrapper
from types import FunctionType
from typing import Any, Generic, ParamSpec, TypeVar, cast

import saga_fg.kernels

P = ParamSpec("P")
R = TypeVar("R")

log = logging.getLogger(__name__)
_OPTIONS = {"error_model": "numpy", "nogil": True, "no_cfunc_wrapper": True}
_SCALARS = {"f": "float64", "i": "int64", "b": "boolean", "u": "uint32"}
_kernels: list[Kernel[Any, Any]] = []  # of the modules that were imported
_parts: set[Callable[..., Any]] = set()  # functions that kernels of the same module call
_enabled: bool | None = None  # None: nobody has asked yet
_listening = False
_said: set[str] = set()


def compiled_kernels() -> bool:
    """True where kernels are used, false where NumPy alone is; Numba is imported at the first call."""
    global _enabled
    if _enabled is None:
        _enabled = _numba_works()
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


def load_kernels() -> None:
    """Load or compile all kernels, so that no frame waits for it."""
    if compiled_kernels():
        for module in pkgutil.iter_modules(saga_fg.kernels.__path__):
            importlib.import_module(f"saga_fg.kernels.{module.name}")
        for each in _kernels:
            each.load()


def _numba_works() -> bool:
    if os.environ.get("NUMBA_DISABLE_JIT") == "1" or importlib.util.find_spec("numba") is None:
        return False
    try:
        numba: Any = importlib.import_module("numba")  # takes as long as all else that a command imports
    except Exception as error:  # too old for this NumPy, or a library that is missing
        log.warning("Numba does not work here, NumPy is used instead: %s", error)
        return False
    return not numba.config.DISABLE_JIT


class Kernel(Generic[P, R]):
    """A function that is compiled when it is first called; `source` is the function itself."""

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
            with _garbage_uncollected():
                self._compiled = cast(Callable[P, R], _compiled(self.source, self._arguments))
        return self._compiled


def kernel(arguments: str) -> Callable[[Callable[P, R]], Kernel[P, R]]:
    """Decorate a function to be compiled for arguments of these kinds, with spaces between.

    f, i, b, u are a float, an integer, a truth value, the code of a character; followed by a digit an array of as
    many dimensions, which is only read, of any strides, or contiguous where a c follows.
    """
    return lambda source: Kernel(source, arguments)


class Choice(Generic[P, R]):
    """A function in two versions of the same arguments and results: `compiled` where kernels are used, else NumPy's."""

    def __init__(
        self, numpy_version: Callable[P, R], compiled: Callable[P, R], where: Callable[P, bool] | None
    ) -> None:
        self.numpy_version, self.compiled, self.where = numpy_version, compiled, where
        self.__name__ = numpy_version.__name__
        update_wrapper(self, numpy_version)
        choices.append(self)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        if not (_enabled or compiled_kernels()) or (self.where is not None and not self.where(*args, **kwargs)):
            return self.numpy_version(*args, **kwargs)
        return self.compiled(*args, **kwargs)


choices: list[Choice[Any, Any]] = []  # of the modules that were imported


def compiled_by(
    compiled: Callable[P, R], where: Callable[P, bool] | None = None
) -> Callable[[Callable[P, R]], Choice[P, R]]:
    """Decorate a NumPy function: a kernel, or its caller, does its work where kernels are used and `where` holds."""
    return lambda numpy_version: Choice(numpy_version, compiled, where)


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


def _compiled(source: Callable[..., Any], arguments: str) -> Any:
    numba: Any = importlib.import_module("numba")
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
            folder = function.stats.cache_path or "disk"
            _say_once("kernels cannot be loaded from %s or kept there, and are compiled anew: %s", folder, repr(error))
            if function.signatures:
                break
            if attempt == "last":
                return numba.njit(signature, **_OPTIONS)(source)
            with suppress(Exception):
                function._cache.flush()  # what is damaged is forgotten, and written anew
    function.disable_compile()
    return function


def _with_compiled_parts(source: Callable[..., Any]) -> Callable[..., Any]:
    """The function with its parts compiled, and theirs."""
    names = [name for name in source.__code__.co_names if source.__globals__.get(name) in _parts]
    if not names:
        return source
    parts = {name: _compiled_part(source.__globals__[name]) for name in names}
    return update_wrapper(FunctionType(source.__code__, source.__globals__ | parts, source.__name__), source)


@cache  # kernels share their parts
def _compiled_part(source: Callable[..., Any]) -> Any:
    numba: Any = importlib.import_module("numba")
    return numba.njit(**_OPTIONS, no_cpython_wrapper=True)(_with_compiled_parts(source))


def _argument(types: Any, kind: str) -> Any:
    scalar = getattr(types, _SCALARS[kind[0]])
    if len(kind) == 1:
        return scalar
    return types.Array(scalar, int(kind[1]), "C" if kind.endswith("c") else "A", readonly=True)


def _say_once(message: str, *values: str) -> None:
    if message not in _said:
        _said.add(message)
        log.warning(message, *values)


def _announce_compilation() -> None:
    """Say once that kernels are being compiled, which takes seconds, when the first of them is not found on disk."""
    global _listening
    if _listening:
        return
    _listening = True
    event: Any = importlib.import_module("numba.core.event")

    class Announcement(event.Listener):  # type: ignore[misc]
        def on_start(self, event: Any) -> None:
            _say_once("compiling kernels that this installation has not run yet: up to twenty seconds")

        def on_end(self, event: Any) -> None:
            pass

    event.register("numba:compile", Announcement())

"""The state of a service in one file: trees of plain values, written again and again, restored.

A service's state on disk: one file, written whole or not at all, for its owner alone.

    saga-fg state 1                  the format and its version
    9f86d0...                        SHA-256 of all that follows, in hexadecimal
    {"version": ...}                 the header: version, method and configuration, plain JSON
    [null, 1.5, ...]                 the nodes of the tree of values, JSON (see below)
    ...                              the bytes of its arrays

The sum finds damage, not forgery: who can write the file decides the state of the service.

Trees of plain values as JSON and raw arrays, and back, without pickle: nothing in them can run code.

A tree is made of None, bool, int, float (infinite and NaN too), str, tuple, list, dict, frozenset, NumPy arrays and
scalars of numbers, truth values and texts, and objects of `saga_fg` and `factors`. As JSON it is a list of nodes; a
node refers to its parts by their places before its own, and the last node is the root. A shared value is one node.

Objects are dataclasses and named tuples. They are made again by the constructors of their classes, which check their
arguments; classes that are not loaded are refused, and so are tables whose columns have different lengths. A running
graph is made again from its record. Of functions there are the methods of `METHODS` of such objects, by which nonlinear
factors are evaluated.
"""

import fcntl
import hashlib
import json
import logging
import math
import os
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import MethodType
from typing import Any, Literal

import numpy as np

from data_tools.files import atomic_file, check_writable, remove_leftovers
from pipelines.serving.settings import LogLimit
from pipelines.serving.stream import StreamTracker
from saga_fg.errors import InputError
from saga_fg.graph import GraphRecord, SceneFactorGraph
from saga_fg.numerics import Columns

PACKAGES = ("saga_fg", "factors")
METHODS = ("residual", "jacobians", "residual_jacobians")
KINDS = "biufU"  # of arrays: truth values, integers, floating point numbers, texts
ALIGNMENT = 8
MAX_DIMENSIONS = 8  # of an array; compiled functions take no more than some dozens


class TreeWriter:
    """Collects the nodes (JSON values) and the bytes of the arrays of one tree.

    Raises `InputError` for a value that is none of the kinds above, and for one that holds itself.
    """

    def __init__(self, value: Any) -> None:
        self.nodes: list[Any] = []
        self.arrays = bytearray()
        self._place: dict[int, int] = {}
        self._within: set[int] = set()
        self._alive: list[Any] = []  # as long as ids count
        self._add(value)

    def _add(self, value: Any) -> int:
        if id(value) in self._place:
            return self._place[id(value)]
        if id(value) in self._within:
            raise InputError(f"{type(value).__name__}: expected a tree of values, this one holds itself")
        self._within.add(id(value))
        node = self._node(value)
        self._within.discard(id(value))
        self._alive.append(value)
        self._place[id(value)] = len(self.nodes)
        self.nodes.append(node)
        return len(self.nodes) - 1

    def _node(self, value: Any) -> Any:
        cls = type(value)
        if value is None or cls in (bool, int, str):
            return value
        if cls is float:
            return value if math.isfinite(value) else {"float": repr(value)}
        if cls is tuple or cls is list:
            return {cls.__name__: [self._add(part) for part in value]}
        if cls is dict:
            return {"dict": [[self._add(key), self._add(part)] for key, part in value.items()]}
        if cls is frozenset:
            return {"frozenset": [self._add(part) for part in sorted(value)]}
        if cls is SceneFactorGraph:
            return {"graph": self._add(GraphRecord.from_graph(value))}
        if cls is MethodType and value.__name__ in METHODS:
            return {"method": [self._add(value.__self__), value.__name__]}
        if isinstance(value, np.generic):
            return {"scalar": self._add(np.asarray(value))}
        if cls is np.ndarray:
            return {"array": self._array(value)}
        if cls.__module__.split(".")[0] in PACKAGES and "." not in cls.__qualname__ and _is_record(cls):
            parts = {name: self._add(part) for name, part in _attributes(value).items()}
            return {"object": [cls.__module__, cls.__qualname__], "parts": parts}
        what = getattr(value, "__qualname__", cls.__qualname__)
        raise InputError(f"{cls.__module__}.{what}: expected a value that can be written to a state file")

    def _array(self, value: np.ndarray[Any, Any]) -> list[Any]:
        if value.dtype.kind not in KINDS or not value.dtype.isnative:
            raise InputError(f"array of {value.dtype}: expected numbers, truth values or texts")
        order: Literal["F", "C"] = "F" if value.flags.f_contiguous and not value.flags.c_contiguous else "C"
        self.arrays += bytes(-len(self.arrays) % ALIGNMENT)
        start = len(self.arrays)
        self.arrays += value.tobytes(order)
        return [value.dtype.str, list(value.shape), order, value.flags.writeable, start]


def read_tree(nodes: list[Any], arrays: bytes) -> Any:
    """Return the value that was written. Raises `InputError` for unknown nodes, and the errors of constructors."""
    values: list[Any] = []
    for node in nodes:
        values.append(_value(node, values, arrays))
    if not values:
        raise InputError("state: expected values, there are none")
    return values[-1]


def _value(node: Any, values: list[Any], arrays: bytes) -> Any:
    if node is None or type(node) in (bool, int, str) or (type(node) is float and math.isfinite(node)):
        return node
    match node:
        case {"float": str(text)}:
            return float(text)
        case {"tuple": list(places)}:
            return tuple(_at(values, place) for place in places)
        case {"list": list(places)}:
            return [_at(values, place) for place in places]
        case {"dict": list(pairs)}:
            return {_at(values, key): _at(values, place) for key, place in pairs}
        case {"frozenset": list(places)}:
            return frozenset(_at(values, place) for place in places)
        case {"graph": place} if isinstance(record := _at(values, place), GraphRecord):
            return record.restored()
        case {"method": [place, str(name)]} if name in METHODS and _is_record(type(owner := _at(values, place))):
            return getattr(owner, name)
        case {"scalar": place}:
            return _at(values, place)[()]
        case {"array": [str(dtype), list(shape), str(order), bool(writeable), int(start)]}:
            return _read_array(np.dtype(dtype), tuple(shape), order, writeable, start, arrays)
        case {"object": [str(module), str(name)], "parts": dict(places)}:
            made = _class(module, name)(**{part: _at(values, place) for part, place in places.items()})
            if isinstance(made, Columns):
                made.check_lengths()
            return made
    raise InputError(f"state: unknown node {str(node)[:60]}")


def _at(values: list[Any], place: Any) -> Any:
    if type(place) is not int or not 0 <= place < len(values):
        raise InputError(f"state: expected the place of an earlier node, got {str(place)[:60]}")
    return values[place]


def _read_array(
    dtype: np.dtype[Any], shape: tuple[int, ...], order: Any, writeable: bool, start: int, arrays: bytes
) -> np.ndarray[Any, Any]:
    sizes = len(shape) <= MAX_DIMENSIONS and all(type(n) is int and n >= 0 for n in shape)
    if dtype.kind not in KINDS or not sizes or order not in ("C", "F"):
        text = f"{dtype} {shape} {order}"[:80]
        raise InputError(f"state: expected an array of numbers, truth values or texts, got {text}")
    count = math.prod(shape)
    if start < 0 or start + count * dtype.itemsize > len(arrays):
        raise InputError(f"state: expected {count * dtype.itemsize} bytes of an array, the file ends before")
    if count * dtype.itemsize == 0:
        array = np.zeros(shape, dtype)
    else:
        array = np.frombuffer(arrays, dtype, count, start).reshape(shape, order=order).copy("K")
    array.flags.writeable = writeable
    return array


def _class(module: str, name: str) -> type:
    """Return a record class of `PACKAGES` that is loaded."""
    cls = getattr(sys.modules.get(module), name, None) if module.split(".")[0] in PACKAGES else None
    if not isinstance(cls, type) or cls.__module__ != module or not _is_record(cls):
        raise InputError(f"state: expected a dataclass of {' or '.join(PACKAGES)}, got {module}.{name}"[:200])
    return cls


def _is_record(cls: type) -> bool:
    """Return True for dataclasses and named tuples."""
    return is_dataclass(cls) or (issubclass(cls, tuple) and hasattr(cls, "_fields"))


def _attributes(value: Any) -> dict[str, Any]:
    """Return the arguments of the constructor that makes an object again."""
    if isinstance(value, tuple):
        return dict(zip(type(value)._fields, value, strict=True))  # type: ignore[attr-defined]
    return {field.name: getattr(value, field.name) for field in fields(value) if field.init}


FORMAT = b"saga-fg state 1"


def write_state(path: Path, header: Mapping[str, str], state: Any) -> None:
    """Write a state, and return once it is on the disk.

    Raises `InputError` as `atomic_file` does and for another kind of state, `OSError` for a disk that fails.
    """
    tree = TreeWriter(state)
    lines = [json.dumps(part, separators=(",", ":")).encode() for part in (dict(header), tree.nodes)]
    content = b"\n".join([*lines, bytes(tree.arrays)])
    with atomic_file(path) as file:
        os.fchmod(file.fileno(), 0o600)
        file.write(b"\n".join([FORMAT, hashlib.sha256(content).hexdigest().encode(), content]))
        file.flush()
        os.fsync(file.fileno())
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # the new name, too
    finally:
        os.close(folder)


def read_state(path: Path, header: Mapping[str, str]) -> Any:
    """Return the state that was written with the same header.

    Raises `InputError` for a file that cannot be read, is damaged, or holds the state of something else.
    """
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: expected a state file of `saga-fg serve`, this is no regular file")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: expected a readable state file: {error.strerror or error}") from error
    first, _, rest = content.partition(b"\n")
    digest, _, rest = rest.partition(b"\n")
    if not first.startswith(b"saga-fg state "):
        raise InputError(f"{path}: expected a state file of `saga-fg serve`, this is none")
    if first != FORMAT:
        raise InputError(f"{path}: expected the format {FORMAT.decode()!r}, got {first[:40]!r}")
    if hashlib.sha256(rest).hexdigest().encode() != digest:
        raise InputError(f"{path}: the state file is damaged: its checksum differs; remove it to begin anew")
    there, _, rest = rest.partition(b"\n")
    nodes, _, arrays = rest.partition(b"\n")
    try:
        _require_same(header, json.loads(there))
        return read_tree(json.loads(nodes), arrays)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except Exception as error:  # of constructors, for values of another program
        raise InputError(f"{path}: expected a state of this version: {type(error).__name__}: {error}") from error


def _require_same(here: Mapping[str, str], there: Mapping[str, str]) -> None:
    for name, expected in here.items():
        got = str(there.get(name))
        if got != expected:
            pairs = zip(got.splitlines(), expected.splitlines(), strict=False)
            line, wanted = next(((a, b) for a, b in pairs if a != b), (got[-60:], expected[-60:]))
            raise InputError(
                f"{name}: the state is of another one, {line.strip()[:80]!r} instead of {wanted.strip()[:80]!r}; "
                f"remove the file to begin anew"
            )


log = logging.getLogger(__name__)


class StateKeeper:
    """Writes the state of `stream` to `path` every `every` s in which something happened, and at the end.

    header: version, method and configuration; a file with another header is refused

    A lock beside the file, `.NAME.lock`, keeps other keepers away from `restore` to `stop`, and no longer than the
    process lives.

    The stream waits while its state is collected, not while it is written. A full disk is a warning, and shown in the
    stream's status; writing is tried again.
    """

    def __init__(self, stream: StreamTracker[Any], path: Path, every: float, header: Mapping[str, str]) -> None:
        self._stream = stream
        self._path = path
        self._every = every
        self._header = header
        self._writing = threading.Lock()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="state keeper", daemon=True)
        self._version = -1  # that is on the disk
        self._written_at: float | None = None
        self._log_limit = LogLimit()
        self._error: str | None = None
        self._lock: int | None = None

    def restore(self) -> bool:
        """Let the stream go on from the file; return False if there is none yet.

        Raises `InputError` for a damaged file, one of another configuration or of a service that runs, and for a place
        that is not writable.
        """
        check_writable(self._path)
        self._lock = _locked(self._path)
        there = self._path.exists()
        if there:
            try:
                state = read_state(self._path, self._header)
            except InputError:
                self.release()
                raise
            try:
                self._stream.restore(state)
            except Exception as error:  # of values that do not fit each other
                self.release()
                text = f"{self._path}: expected a state that fits: {type(error).__name__}: {error}"
                raise InputError(text) from error
            self._version = self._stream.version
        self._stream.keeper = self
        return there

    def start(self) -> None:
        """Begin to write."""
        self.clear_leftovers()
        self._thread.start()

    def stop(self) -> None:
        """Write a last time and end."""
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join()
        self.release()

    def release(self) -> None:
        """Release the lock."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def clear_leftovers(self) -> None:
        """Remove half-written files of a killed process."""
        remove_leftovers(self._path.parent, of=self._path.name)

    def save(self) -> bool:
        """Write the state unless it is on the disk already; return True if it is there now."""
        with self._writing:
            try:
                if self._stream.version == self._version:
                    return True
                state, durable, version = self._stream.state()
                write_state(self._path, self._header, state)
            except Exception as error:
                self._warn(error)
                return False
            self._version, self._written_at, self._error = version, time.monotonic(), None
            self._stream.made_durable(durable)
            return True

    def status(self) -> dict[str, Any]:
        """Return the age of the file in s (None: not written by this process) and the error of the latest attempt."""
        age = None if self._written_at is None else round(time.monotonic() - self._written_at, 3)
        return {"age": age, "error": self._error}

    def _run(self) -> None:
        while not self._stopping.wait(self._every):
            self.save()
        self.save()

    def _warn(self, error: Exception) -> None:
        self._error = " ".join(f"{error}".split())[:300]
        if self._log_limit.due(type(error).__name__):
            unexpected = None if isinstance(error, InputError | OSError) else error
            log.warning("the state is not kept: %s", self._error, exc_info=unexpected)


def _locked(path: Path) -> int:
    """Lock a state file; return the descriptor that holds the lock. Raises `InputError` if another process does."""
    final = path.resolve()
    try:
        lock = os.open(final.with_name(f".{final.name}.lock"), os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        raise InputError(f"{path}: expected a place for a lock beside it: {error.strerror or error}") from error
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(lock)
        if isinstance(error, BlockingIOError):
            raise InputError(f"{path}: another service keeps its state in this file") from error
        raise InputError(f"{path}: expected a file system with locks: {error.strerror or error}") from error
    return lock

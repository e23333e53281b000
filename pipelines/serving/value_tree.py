"""Trees of plain values as JSON and raw arrays, and back, without pickle: nothing in them can run code.

A tree is made of None, bool, int, float (infinite and NaN too), str, tuple, list, dict, frozenset, NumPy arrays and
scalars of numbers, truth values and texts, and objects of `saga_fg` and `factors`. As JSON it is a list of nodes; a
node refers to its parts by their places before its own, and the last node is the root. A shared value is one node.

Objects are dataclasses and named tuples. They are made again by the constructors of their classes, which check their
arguments; classes that are not loaded are refused. A running graph is made again from its record. Of functions there
are the methods of `METHODS` of such objects, by which nonlinear factors are evaluated.
"""

from __future__ import annotations

import math
import sys
from dataclasses import fields, is_dataclass
from types import MethodType
from typing import Any, Literal

import numpy as np

from saga_fg.errors import InputError
from saga_fg.graph.scene_factor_graph import GraphRecord, SceneFactorGraph

PACKAGES = ("saga_fg", "factors")
METHODS = ("residual", "jacobians", "residual_jacobians")
KINDS = "biufU"  # of arrays: truth values, integers, floating point numbers, texts
ALIGNMENT = 8


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
            return {"graph": self._add(GraphRecord.of(value))}
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
    if node is None or type(node) in (bool, int, float, str):
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
            return _class(module, name)(**{part: _at(values, place) for part, place in places.items()})
    raise InputError(f"state: unknown node {str(node)[:60]}")


def _at(values: list[Any], place: Any) -> Any:
    if type(place) is not int or not 0 <= place < len(values):
        raise InputError(f"state: expected the place of an earlier node, got {str(place)[:60]}")
    return values[place]


def _read_array(
    dtype: np.dtype[Any], shape: tuple[int, ...], order: Any, writeable: bool, start: int, arrays: bytes
) -> np.ndarray[Any, Any]:
    if dtype.kind not in KINDS or any(type(n) is not int or n < 0 for n in shape) or order not in ("C", "F"):
        raise InputError(f"state: expected an array of numbers, truth values or texts, got {dtype} {shape} {order}")
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

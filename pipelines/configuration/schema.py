"""Schema of settings dataclasses, shared by reading, writing and documenting them.

| type hint of the field                  | schema     | in YAML                                                     |
|-----------------------------------------|------------|-------------------------------------------------------------|
| bool, int, float, str                   | `Scalar`   | true, 3, 0.5, text                                          |
| Literal["a", "b"]                       | `Choice`   | one of the words                                            |
| tuple[X, ...], tuple[X, Y]              | `Listing`  | a list                                                      |
| Mapping[str, X]                         | `Table`    | keys of one's own choice                                    |
| a dataclass, or a union of dataclasses  | `Section`  | a section; of a union, its `kind:` says which dataclass     |
| X | None                                | `Nullable` | null, or X                                                  |
| str | FactorProvider                    | `Imported` | MODULE:NAME, or a section: `kind: MODULE:NAME`, and settings |

The kind of a dataclass is its attribute `kind` if it has one, else its name in snake case without "Settings".
"""

from __future__ import annotations

import dataclasses
import re
import types
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from saga_fg.graph import FactorProvider
from saga_fg.settings import Range, range_of


@dataclass(frozen=True)
class Scalar:
    type: type[bool] | type[int] | type[float] | type[str]


@dataclass(frozen=True)
class Choice:
    options: tuple[Any, ...]


@dataclass(frozen=True)
class Listing:
    items: tuple[Schema, ...]  # one schema for any length, or one for each entry
    any_length: bool


@dataclass(frozen=True)
class Table:
    value: Schema


@dataclass(frozen=True)
class Section:
    classes: tuple[type, ...]

    def class_of_kind(self, kind: str) -> type | None:
        return next((cls for cls in self.classes if kind_of(cls) == kind), None)


@dataclass(frozen=True)
class Nullable:
    value: Schema


@dataclass(frozen=True)
class Imported:
    """Something by the name of what makes it; with settings, which are a dataclass, itself."""


Schema = Scalar | Choice | Listing | Table | Section | Nullable | Imported


@dataclass(frozen=True)
class Setting:
    """One field of a settings dataclass."""

    name: str
    schema: Schema
    comment: str
    bounds: str  # of its numbers, such as "> 0"
    field: dataclasses.Field[Any]

    @property
    def required(self) -> bool:
        return self.field.default is dataclasses.MISSING and self.field.default_factory is dataclasses.MISSING

    def default(self) -> Any:
        """The default value; not to be asked of a required field."""
        if self.field.default is not dataclasses.MISSING:
            return self.field.default
        assert self.field.default_factory is not dataclasses.MISSING
        return self.field.default_factory()


def kind_of(cls: type) -> str:
    """The word that chooses `cls` in a union: its attribute `kind`, or its name: `LaneKernelSettings`: lane_kernel."""
    kind = getattr(cls, "kind", None)
    if isinstance(kind, str):
        return kind
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__.removesuffix("Settings")).lower()


def settings_of(cls: type) -> tuple[Setting, ...]:
    """The fields of a settings dataclass, in order. Raises `TypeError` for a type that YAML cannot hold."""
    hints, annotated = get_type_hints(cls), get_type_hints(cls, include_extras=True)
    result = []
    for field in dataclasses.fields(cls):
        if field.init:
            try:
                schema = schema_of(hints[field.name])
            except TypeError as error:
                raise TypeError(f"{cls.__name__}.{field.name}: {error}") from error
            allowed = range_of(annotated[field.name])
            bounds = allowed.bounds if isinstance(allowed, Range) else ""
            result.append(Setting(field.name, schema, field.metadata.get("comment", ""), bounds, field))
    return tuple(result)


def schema_of(hint: Any) -> Schema:
    """The schema of a type hint. Raises `TypeError` for a type that YAML cannot hold."""
    origin, arguments = get_origin(hint), get_args(hint)
    if hint in (bool, int, float, str):
        return Scalar(hint)
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return Section((hint,))
    if origin is Literal:
        return Choice(arguments)
    if origin in (Union, types.UnionType):
        return _union(arguments)
    if origin is tuple and arguments:
        if arguments[-1] is Ellipsis:
            return Listing((schema_of(arguments[0]),), any_length=True)
        return Listing(tuple(schema_of(a) for a in arguments), any_length=False)
    if isinstance(origin, type) and issubclass(origin, Mapping) and arguments[0] is str:
        value = schema_of(arguments[1])
        if isinstance(value, Nullable):
            raise TypeError("a mapping to optional values has no YAML form: null takes an entry away")
        return Table(value)
    raise TypeError(f"{hint} has no YAML form")


def _union(arguments: tuple[Any, ...]) -> Schema:
    if set(arguments) == {str, FactorProvider}:
        return Imported()
    if type(None) in arguments:
        rest = tuple(a for a in arguments if a is not type(None))
        return Nullable(schema_of(rest[0]) if len(rest) == 1 else _union(rest))
    if all(isinstance(a, type) and dataclasses.is_dataclass(a) for a in arguments):
        return Section(arguments)
    raise TypeError(f"a union of {', '.join(str(a) for a in arguments)} has no YAML form")

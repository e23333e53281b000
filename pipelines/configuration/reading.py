"""Settings dataclasses from YAML, by a schema that reading, writing and documenting them share.

| type hint of the field                  | schema     | in YAML                                                     |
|-----------------------------------------|------------|-------------------------------------------------------------|
| bool, int, float, str                   | `Scalar`   | true, 3, 0.5, text                                          |
| Literal["a", "b"]                       | `Choice`   | one of the words                                            |
| tuple[X, ...], tuple[X, Y]              | `Listing`  | a list                                                      |
| Mapping[str, X]                         | `Table`    | keys of one's own choice                                    |
| a dataclass, or a union of dataclasses  | `Section`  | a section; of a union, its `kind:` says which dataclass     |
| X | None                                | `Nullable` | null, or X                                                  |

Where a type or one of a union is that of a kind of part (`saga_fg.parts`), a part of a user's own stands there by its
name: alone, or as the `kind` of a section with its settings, if it is a dataclass. Beside `str`, a name alone is kept,
and looked up where it is used.

The kind of a dataclass is its attribute `kind` if it has one, else its name in snake case without "Settings".

What a file leaves out keeps its default.

* A section overrides field by field, a table (`Mapping`) entry by entry: an entry the defaults lack starts from the
  table's entry `default` where there is one, and `null` takes an entry away. A list replaces the default list.
* A key that does not exist is an error that names the nearest one; so are a value of a wrong type and a key twice.
* Numbers may be written as `1e-3`, which YAML 1.1 takes for text.
"""

from __future__ import annotations

import dataclasses
import difflib
import re
import types
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import yaml

from data_tools.files import read_text
from saga_fg.errors import InputError
from saga_fg.parts import PartKind, as_part, find, kind_among, names_of
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
    kind: type[list[Any]] | type[tuple[Any, ...]] = tuple


@dataclass(frozen=True)
class Table:
    value: Schema


@dataclass(frozen=True)
class Section:
    classes: tuple[type, ...]
    part: PartKind | None = None  # parts of a user's own that may stand in its place
    kept_name: bool = False  # a name alone is a value

    def kind_of(self, cls: type) -> str:
        """The word or name that chooses a class."""
        return kind_of(cls) if cls in self.classes else f"{cls.__module__}:{cls.__qualname__}"


@dataclass(frozen=True)
class Nullable:
    value: Schema


Schema = Scalar | Choice | Listing | Table | Section | Nullable


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
    """The word that chooses `cls` in a union: its attribute `kind`, or its name: `RandomWalk`: random_walk."""
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
        return Section((hint,), kind_among([hint]))
    if origin is Literal:
        return Choice(arguments)
    if origin in (Union, types.UnionType):
        return _union(arguments)
    if origin is list:
        return Listing((schema_of(arguments[0]),), any_length=True, kind=list)
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
    if type(None) in arguments:
        rest = tuple(a for a in arguments if a is not type(None))
        return Nullable(schema_of(rest[0]) if len(rest) == 1 else _union(rest))
    classes = tuple(a for a in arguments if isinstance(a, type) and dataclasses.is_dataclass(a))
    part = kind_among(arguments)
    roles = () if part is None else (str, *part.roles)
    if all(a in classes or a in roles for a in arguments):
        return Section(classes, part, str in arguments)
    raise TypeError(f"a union of {', '.join(str(a) for a in arguments)} has no YAML form")


T = TypeVar("T")
LARGEST = 2**63 - 1  # whole number
DEFAULT_ENTRY = "default"
_NAMES = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}


def load_settings(cls: type[T], path: Path, base: T | None = None, other_files: Mapping[str, str] | None = None) -> T:
    """The settings of a YAML file over `base` (default: `cls()`).

    other_files  commands by the sections that only their files have, for the error

    Raises `InputError` naming file and dotted key.
    """
    return read_settings(cls, read_text(path), str(path), base, other_files)


def read_settings(
    cls: type[T],
    text: str,
    source: str = "configuration",
    base: T | None = None,
    other_files: Mapping[str, str] | None = None,
) -> T:
    """The settings of a YAML text; `source` is the name that errors give to it."""
    try:
        data = _Loader(text).get_single_data()
        for section, command in (other_files or {}).items():
            if isinstance(data, dict) and section in data:
                raise InputError(f"{section}: unknown section, this is a file for `{command}`")
        return cast(T, _read(Section((cls,)), {} if data is None else data, base, ""))
    except InputError as error:
        raise InputError(f"{source}: {error}") from error
    except (yaml.YAMLError, ValueError) as error:  # ValueError: PyYAML on a date such as 2020-02-31
        raise InputError(f"{source}: expected YAML: {_one_line(error)}") from error
    except RecursionError as error:
        raise InputError(f"{source}: expected settings, this YAML is nested too deeply") from error


def _read(schema: Schema, data: Any, base: Any, where: str) -> Any:
    match schema:
        case Nullable(value):
            return None if data is None else _read(value, data, base, where)
        case Scalar(type=kind):
            return _read_scalar(kind, data, where)
        case Choice(options):
            if not any(type(data) is type(option) and data == option for option in options):
                raise _mismatch(where, "one of " + ", ".join(map(str, options)), data)
            return data
        case Listing():
            return _read_listing(schema, data, where)
        case Table(value):
            return _read_table(value, data, base, where)
        case Section():
            return _read_part(schema, data, base, where)


def _read_scalar(kind: type, data: Any, where: str) -> Any:
    if kind is float and isinstance(data, str):
        try:
            data = float(data)
        except ValueError:
            raise _mismatch(where, "a number", data) from None
    if kind is float and isinstance(data, int) and not isinstance(data, bool) and abs(data) < 2**1023:
        data = float(data)
    if type(data) is not kind or (isinstance(data, int) and abs(data) > LARGEST):
        raise _mismatch(where, _NAMES[kind], data)
    return data


def _read_listing(schema: Listing, data: Any, where: str) -> list[Any] | tuple[Any, ...]:
    if not isinstance(data, list):
        raise _mismatch(where, "a list", data)
    if schema.any_length:
        return schema.kind(_read(schema.items[0], entry, None, f"{where}[{k}]") for k, entry in enumerate(data))
    if len(data) != len(schema.items):
        raise InputError(f"{where}: expected a list of {len(schema.items)}, got {len(data)} entries")
    return tuple(_read(s, d, None, f"{where}[{k}]") for k, (s, d) in enumerate(zip(schema.items, data, strict=True)))


def _read_table(value: Schema, data: Any, base: Any, where: str) -> dict[str, Any]:
    result = dict(base) if base is not None else {}
    for key in sorted(_text_keys(data, where), key=lambda key: key != DEFAULT_ENTRY):  # what others start from first
        if data[key] is None:
            result.pop(key, None)
        else:
            start = result.get(key, result.get(DEFAULT_ENTRY))
            result[key] = _read(value, data[key], start, _join(where, key))
    return result


def _read_part(schema: Section, data: Any, base: Any, where: str) -> Any:
    """A section, or a part of a user's own by its name."""
    if schema.part is None:
        return _read_section(schema, data, base, where)
    if isinstance(data, str) and schema.kept_name:
        return data
    part = _read_section(schema, {"kind": data} if isinstance(data, str) else data, base, where)
    schema.part.require(where, part)
    return part


def _read_section(schema: Section, data: Any, base: Any, where: str) -> Any:
    keys = _text_keys(data, where)
    choice = len(schema.classes) != 1
    cls = schema.classes[0] if base is None and schema.classes else type(base)
    if ("kind" in keys and (choice or schema.part)) or (choice and (base is None or isinstance(base, str))):
        cls = _class_of_kind(schema, data, where)
    values = {key: data[key] for key in keys if key != "kind" or not (choice or schema.part)}
    if schema.part and not (isinstance(cls, type) and dataclasses.is_dataclass(cls)):
        if values:
            raise InputError(f"{where}.kind: {data['kind']}: expected a dataclass, whose fields are its settings")
        return as_part(where, cls, schema.part)
    try:
        settings = {setting.name: setting for setting in settings_of(cls)}
    except (TypeError, NameError) as error:  # of a part of a user's own
        raise InputError(f"{where}: {error}") from error
    for key in values:
        if key not in settings:
            raise InputError(f"{_join(where, key[:40])}: unknown key, {_suggestion(key, settings)}")
    start = base if isinstance(base, cls) or issubclass(cls, type(base)) else None
    for name, setting in settings.items():
        before = getattr(start, name) if hasattr(start, name) else None if setting.required else setting.default()
        if name in values:
            values[name] = _read(setting.schema, values[name], before, _join(where, name))
        elif setting.required and not hasattr(start, name):
            raise InputError(f"{_join(where, name)}: expected a value, the key is missing")
        else:
            values[name] = before
    try:
        return cls(**values)
    except InputError as error:
        raise InputError(f"{where}: {error}" if where else str(error)) from error


def _class_of_kind(schema: Section, data: dict[str, Any], where: str) -> type:
    """The class of the kind of a section; what a user's name stands for is a class, or a function that makes a part."""
    own = {kind_of(cls): cls for cls in schema.classes}
    kinds = [*own, *(names_of(schema.part.group) if schema.part else ()), *(["MODULE:NAME"] if schema.part else [])]
    expected = f"one of {', '.join(kinds)}" if len(kinds) > 1 else kinds[0]
    if "kind" not in data:
        raise InputError(f"{where}.kind: expected {expected}, the key is missing")
    if not isinstance(data["kind"], str):
        raise _mismatch(f"{where}.kind", expected, data["kind"])
    if schema.part and data["kind"] not in own and (":" in data["kind"] or data["kind"] in kinds):
        found: type = find(f"{where}.kind", data["kind"], schema.part.group)
        return found
    if data["kind"] not in own:
        raise InputError(f"{where}.kind: got {data['kind'][:40]!r}, {_suggestion(data['kind'], kinds)}")
    return own[data["kind"]]


def _text_keys(data: Any, where: str) -> list[str]:
    if not isinstance(data, dict):
        raise _mismatch(where, "a section (key: value)", data)
    for key in data:
        if not isinstance(key, str):
            raise InputError(
                f"{_join(where, str(key)[:40])}: expected a key that is text, got {str(key)[:40]} (quote it)"
            )
    return list(data)


def _suggestion(key: str, known: Iterable[str]) -> str:
    nearest = difflib.get_close_matches(key, list(known), n=1, cutoff=0.5)
    return f"did you mean {nearest[0]!r}?" if nearest else "expected one of " + ", ".join(known)


def _mismatch(where: str, expected: str, data: Any) -> InputError:
    names = {dict: "a section", list: "a list", type(None): "nothing (null)"}
    got = names.get(type(data)) or (f"the text {data[:40]!r}" if isinstance(data, str) else str(data)[:40].lower())
    return InputError(f"{where or 'the top level'}: expected {expected}, got {got}")


def _join(where: str, key: str) -> str:
    return f"{where}.{key}" if where else key


class _Loader(yaml.SafeLoader):
    """Refuses equal keys, of which PyYAML keeps the last: a configuration that says two things is a mistake."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [key for key, _ in reversed(node.value) if isinstance(key, yaml.ScalarNode)]
        count = Counter(key.value for key in keys)
        twice = next((key for key in keys if count[key.value] > 1), None)
        if twice is not None:
            raise InputError(f"line {twice.start_mark.line + 1}: the key {twice.value!r} occurs twice in a section")
        return super().construct_mapping(node, deep)


def _one_line(error: Exception) -> str:
    mark = getattr(error, "problem_mark", None)
    problem = getattr(error, "problem", None) or str(error).splitlines()[0]
    return f"line {mark.line + 1}, column {mark.column + 1}: {problem}" if mark else str(problem)

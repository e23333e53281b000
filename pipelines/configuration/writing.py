"""Settings dataclasses to YAML that people read: every value, each with its comment, and exact on the way back.

A table's second and later entries repeat the keys but not the comments. Entries that the defaults hold and the
settings do not are written as `null`, which takes them away when the text is read over the defaults.

A selection names settings by dotted keys, `*` for every entry of a table: `tracker.classes.*.max_deviation`.
"""

import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass
from typing import Any

import yaml

from pipelines.configuration.reading import (
    DEFAULT_ENTRY,
    Choice,
    Listing,
    Nullable,
    Schema,
    Section,
    Setting,
    Table,
    settings_of,
)
from saga_fg.parts import part_name

WIDTH = 120
EVERYTHING = ("",)  # the selection of a whole section
_PLAIN = re.compile(r"[A-Za-z][A-Za-z0-9_./ -]*(?<! )")


def write_settings(settings: Any, comments: bool = True, selection: Sequence[str] = EVERYTHING) -> str:
    """The YAML text of a settings dataclass; `read_settings(type(settings), text)` gives back an equal one.

    Of a `selection` of dotted keys, only these are written, values before sections, to be read over the same settings.
    """
    lines = _section_lines(Section((type(settings),)), settings, None, comments, selection)
    starts = [k for k, line in enumerate(lines) if line.endswith(":") and not line.startswith((" ", "#"))]
    for start in reversed(starts):  # air between the sections of the top level
        while start > 0 and lines[start - 1].startswith("#"):
            start -= 1
        if start > 0:
            lines.insert(start, "")
    return "\n".join(lines) + "\n"


def scalar_text(value: Any) -> str:
    """A number or a word as YAML: floats keep all digits and stay floats for every YAML reader."""
    if isinstance(value, str) and _PLAIN.fullmatch(value) and yaml.safe_load(value) == value:
        return value
    style = '"' if isinstance(value, str) else None
    text: str = yaml.safe_dump(value, default_style=style, width=2**31, allow_unicode=True)
    return text.removesuffix("...\n").rstrip("\n")


def _below(selection: Sequence[str], key: str) -> Sequence[str]:
    """The part of a selection that lies below a key; empty: the key is not selected."""
    if "" in selection:
        return EVERYTHING
    parts = (name.partition(".") for name in selection)
    return [rest for head, _, rest in parts if head in (key, "*")]


def _section_lines(
    schema: Section, settings: Any, base: Any, comments: bool, selection: Sequence[str] = EVERYTHING
) -> list[str]:
    entries: list[tuple[list[str], str]] = []
    if len(schema.classes) != 1 or type(settings) not in schema.classes:
        own = ", ".join(schema.kind_of(cls) for cls in schema.classes)
        kind = scalar_text(schema.kind_of(type(settings)))
        entries.append(([f"kind: {kind}"], f"one of {own}" if comments and own else ""))
    same = type(base) is type(settings)
    for item in settings_of(type(settings)) if is_dataclass(settings) else ():
        below = _below(selection, item.name)
        if not below or (len(schema.classes) > 1 and item.name == "kind"):
            continue
        before = getattr(base, item.name) if same else None if item.required else item.default()
        lines = _entry_lines(item.name, _form(item.schema, getattr(settings, item.name), before, comments, below))
        entries.append((lines, _comment(item) if comments else ""))
    if "" not in selection:
        entries.sort(key=lambda entry: len(entry[0]) > 1)
    return _with_comments(entries)


def _comment(item: Setting) -> str:
    schema = item.schema.value if isinstance(item.schema, Nullable) else item.schema
    if not isinstance(schema, Choice) or all(f"{option}:" in item.comment for option in schema.options):
        return item.comment
    return f"{item.comment} ({' | '.join(scalar_text(option) for option in schema.options)})"


def _form(
    schema: Schema, value: Any, base: Any, comments: bool, selection: Sequence[str] = EVERYTHING
) -> str | list[str]:
    """Return a value as YAML: text on the line of its key, or a list of lines below it."""
    while isinstance(schema, Nullable) and value is not None:
        schema = schema.value
    match schema:
        case Section() if not isinstance(value, str):
            if hasattr(value, "__qualname__"):  # a class or a function
                return scalar_text(part_name(value))
            return _section_lines(schema, value, base, comments, selection) or "{}"
        case Table(value=inner):
            return _table_lines(inner, value, base, comments, selection) or "{}"
        case Listing():
            items = schema.items * len(value) if schema.any_length else schema.items
            forms = [
                _form(item, entry, None, comments and type(entry) not in map(type, value[:k]))
                for k, (item, entry) in enumerate(zip(items, value, strict=True))
            ]
            if all(isinstance(form, str) for form in forms):
                return "[" + ", ".join(map(str, forms)) + "]"
            return [line for form in forms for line in _dashed([form] if isinstance(form, str) else form)]
    return scalar_text(value)


def _table_lines(
    inner: Schema, value: Mapping[str, Any], base: Mapping[str, Any] | None, comments: bool, selection: Sequence[str]
) -> list[str]:
    base = base or {}
    lines: list[str] = []
    for k, (key, entry) in enumerate(value.items()):
        before = base.get(key, None if key == DEFAULT_ENTRY else value.get(DEFAULT_ENTRY))
        below = _below(selection, key)
        if below:
            lines += _entry_lines(key, _form(inner, entry, before, comments and k == 0, below))
    return lines + [f"{scalar_text(key)}: null" for key in base if key not in value]


def _entry_lines(key: str, form: str | list[str]) -> list[str]:
    head = scalar_text(key)
    return [f"{head}: {form}"] if isinstance(form, str) else [f"{head}:", *_indented(form)]


def _dashed(lines: list[str]) -> list[str]:
    first = next(k for k, line in enumerate(lines) if not line.startswith("#"))
    return [*_indented(lines[:first]), f"- {lines[first]}", *_indented(lines[first + 1 :])]


def _indented(lines: list[str]) -> list[str]:
    return ["  " + line for line in lines]


def _with_comments(entries: list[tuple[list[str], str]]) -> list[str]:
    """Comments behind one-line entries, in one column; above those that are longer, or when they would not fit."""
    short = [len(lines[0]) for lines, comment in entries if len(lines) == 1 and comment]
    column = max((n for n in short if n <= 44), default=0) + 2
    result: list[str] = []
    for lines, comment in entries:
        if comment and len(lines) == 1 and len(lines[0]) < column and column + 2 + len(comment) <= WIDTH:
            result.append(f"{lines[0]:<{column}}# {comment}")
        else:
            above = textwrap.wrap(comment, WIDTH - 2) if comment else []
            result += [f"# {line}" for line in above] + lines
    return result

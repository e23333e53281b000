"""The configuration reference in Markdown, made from the settings dataclasses alone."""

from __future__ import annotations

import inspect
from typing import Any

from pipelines.configuration.reading import DEFAULT_ENTRY
from pipelines.configuration.schema import (
    Choice,
    Imported,
    Listing,
    Nullable,
    Scalar,
    Schema,
    Section,
    Setting,
    Table,
    kind_of,
    settings_of,
)
from pipelines.configuration.writing import scalar_text

_TYPES = {bool: "true or false", int: "whole number", float: "number", str: "text"}


def settings_reference(cls: type) -> str:
    """One table of keys for each section of `cls`: key, default, type, meaning."""
    parts: list[str] = []
    _document("", cls, cls(), parts)
    return "\n".join(parts)


def _document(where: str, cls: type, settings: Any, parts: list[str]) -> None:
    rows, below = [], []
    for item in settings_of(cls):
        value = getattr(settings, item.name) if settings is not None else None if item.required else item.default()
        shown = "required" if settings is None and item.required else _default_text(item.schema, value)
        rows.append(f"| `{item.name}` | {shown} | {_type_text(item.schema)} | {_cell(item.comment)} |")
        below.append((item, value))
    if where:
        parts += [f"## `{where}`", ""]
    parts += [_first_paragraph(cls), ""]
    if rows:
        parts += ["| key | default | type | meaning |", "|---|---|---|---|", *rows, ""]
    for item, value in below:
        _document_below(f"{where}.{item.name}" if where else item.name, item, value, parts)


def _document_below(where: str, item: Setting, value: Any, parts: list[str]) -> None:
    schema = item.schema
    while True:
        match schema:
            case Nullable(inner):
                schema = inner
            case Table(inner):
                schema, where = inner, f"{where}.<name>"
                value = value.get(DEFAULT_ENTRY, next(iter(value.values()), None)) if value else None
            case Listing(items) if items:
                schema, where, value = items[0], f"{where}[]", None
            case Section(classes):
                for cls in classes:
                    name = f"{where} (kind: {kind_of(cls)})" if len(classes) > 1 else where
                    _document(name, cls, value if type(value) is cls else _default_of(cls), parts)
                return
            case _:
                return


def _default_of(cls: type) -> Any:
    return None if any(item.required for item in settings_of(cls)) else cls()


def _default_text(schema: Schema, value: Any) -> str:
    match schema:
        case Section():
            return "see below"
        case Table():
            return ", ".join(f"`{key}`" for key in value) or "empty"
        case Nullable(inner) if value is not None:
            return _default_text(inner, value)
        case Listing(items):
            if any(isinstance(item, Section) for item in items):
                return ", ".join(f"`{kind_of(type(entry))}`" for entry in value) or "`[]`"
            return "`[" + ", ".join(scalar_text(entry) for entry in value) + "]`"
    return f"`{scalar_text(value)}`"


def _type_text(schema: Schema) -> str:
    match schema:
        case Scalar(type=kind):
            return _TYPES[kind]
        case Choice(options):
            return " or ".join(f"`{scalar_text(option)}`" for option in options)
        case Listing(items, any_length):
            if any_length:
                return f"list of {_plural(_type_text(items[0]))}"
            return f"list of {len(items)}: " + ", ".join(_type_text(item) for item in items)
        case Table(inner):
            return f"table of {_plural(_type_text(inner))}"
        case Section(classes):
            return "section" if len(classes) == 1 else "section of a `kind`"
        case Imported():
            return "name, or section of a `kind`"
        case Nullable(inner):
            return f"{_type_text(inner)}, or `null`"


def _plural(text: str) -> str:
    for noun in ("section", "number", "list", "name"):
        if text.startswith((noun, f"whole {noun}")):
            return text.replace(noun, f"{noun}s", 1)
    return text


def _first_paragraph(cls: type) -> str:
    doc = inspect.getdoc(cls) or ""
    return "" if doc.startswith(f"{cls.__name__}(") else doc.split("\n\n")[0].replace("\n", " ")


def _cell(text: str) -> str:
    return text.replace("|", "\\|")

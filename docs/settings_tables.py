"""Tables of the settings of a dataclass in Markdown, for the site: key, default, type, meaning."""

from __future__ import annotations

import inspect
from typing import Any

from pipelines.configuration.reading import (
    DEFAULT_ENTRY,
    Choice,
    Listing,
    Nullable,
    Scalar,
    Schema,
    Section,
    Table,
    kind_of,
    settings_of,
)
from pipelines.configuration.writing import scalar_text

_TYPES = {bool: "true or false", int: "whole number", float: "number", str: "text"}


def settings_reference(cls: type, documented: dict[tuple[type, str], str] | None = None) -> str:
    """One table of keys for each section of `cls`: key, default, type, meaning.

    documented: places of sections that are on the page already, to be referred to; new ones are added
    """
    parts: list[str] = []
    _document("", "", cls, cls(), parts, {} if documented is None else documented)
    return "\n".join(parts)


def _document(
    where: str, kind: str, cls: type, settings: Any, parts: list[str], documented: dict[tuple[type, str], str]
) -> None:
    title = f"`{where}`{kind}"
    place = documented.setdefault((cls, repr(settings)), title)
    if place != title:
        parts += [f"{title}: the same keys and defaults as {place}.", ""]
        return
    if where:
        if f"## {title}" in parts:
            return
        parts += [f"## {title}", ""]
    parts += [_first_paragraph(cls), ""]
    items = []
    for item in settings_of(cls):
        value = getattr(settings, item.name) if settings is not None else None if item.required else item.default()
        items.append((item, value))
    if items:
        parts += ["| key | default | type | meaning |", "|---|---|---|---|"]
    for item, value in items:
        shown = "required" if settings is None and item.required else _default_text(item.schema, value)
        kind_of_value = _type_text(item.schema, item.bounds)
        comment = item.comment.replace("|", "\\|")
        parts.append(f"| `{item.name}` | {shown} | {kind_of_value} | {comment} |")
    parts.append("")
    for item, value in items:
        owner = kind.replace(", kind", " of")
        _document_below(f"{where}.{item.name}" if where else item.name, owner, item.schema, value, parts, documented)


def _document_below(
    where: str, owner: str, schema: Schema, value: Any, parts: list[str], documented: dict[tuple[type, str], str]
) -> None:
    match schema:
        case Nullable(inner):
            _document_below(where, owner, inner, value, parts, documented)
        case Table(inner):
            entry = value.get(DEFAULT_ENTRY, next(iter(value.values()), None)) if value else None
            _document_below(f"{where}.<name>", owner, inner, entry, parts, documented)
        case Listing(items) if items:
            _document_below(f"{where}[]", owner, items[0], None, parts, documented)
        case Section(classes):
            for cls in classes:
                kind = f", kind `{kind_of(cls)}`" if len(classes) > 1 else owner
                _document(where, kind, cls, value if type(value) is cls else _default_of(cls), parts, documented)


def _default_of(cls: type) -> Any:
    return None if any(item.required for item in settings_of(cls)) else cls()


def _default_text(schema: Schema, value: Any) -> str:
    match schema:
        case Section(classes):
            return f"`{kind_of(type(value))}`" if len(classes) > 1 else "see below"
        case Table():
            return ", ".join(f"`{key}`" for key in value) or "empty"
        case Nullable(inner) if value is not None:
            return _default_text(inner, value)
        case Listing(items):
            if any(isinstance(item, Section) for item in items):
                return ", ".join(f"`{kind_of(type(entry))}`" for entry in value) or "`[]`"
            return "`[" + ", ".join(scalar_text(entry) for entry in value) + "]`"
    return f"`{scalar_text(value)}`"


def _type_text(schema: Schema, bounds: str) -> str:
    match schema:
        case Scalar(type=kind):
            return f"{_TYPES[kind]} {bounds}".rstrip()
        case Choice(options):
            return " or ".join(f"`{scalar_text(option)}`" for option in options)
        case Listing(items, any_length):
            if any_length:
                return f"list of {_plural(_type_text(items[0], bounds))}"
            if len(set(items)) == 1:
                return f"list of {len(items)} {_plural(_type_text(items[0], bounds))}"
            return f"list of {len(items)}: " + ", ".join(_type_text(item, bounds) for item in items)
        case Table(inner):
            return f"table of {_plural(_type_text(inner, bounds))}"
        case Section(classes, kept_name=named):
            return (
                "section"
                if len(classes) == 1
                else "section of a `kind`"
                if not named
                else "name, or section of a `kind`"
            )
        case Nullable(inner):
            return f"{_type_text(inner, bounds)}, or `null`"


def _plural(text: str) -> str:
    for noun in ("section", "number", "list", "name"):
        if text.startswith((noun, f"whole {noun}")):
            return text.replace(noun, f"{noun}s", 1)
    return text


def _first_paragraph(cls: type) -> str:
    doc = inspect.getdoc(cls) or ""
    return "" if doc.startswith(f"{cls.__name__}(") else doc.split("\n\n")[0].replace("\n", " ")

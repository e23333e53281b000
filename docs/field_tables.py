"""Tables of fields and parameters for the API pages, from the docstrings as they are: an extension of griffe.

Docstrings list fields and parameters in a block of lines "name  description", with at least two spaces between and
continuation lines indented. Such a block becomes a section that mkdocstrings shows as a table, with types and defaults.
A dataclass gets a row for every field; the comment of a `setting(default, "comment")` is its description.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable
from typing import Any

import griffe

ENTRY = re.compile(r"(\*{0,2}\w+(?:, \*{0,2}\w+)*) {2,}(\S.*)")
Describe = Callable[[dict[str, str]], Any]
"""Makes a section of the descriptions by name."""


def entries(paragraph: str, known: set[str]) -> dict[str, str]:
    """Descriptions by name; empty if the paragraph is no list, or none of its names is known."""
    found: dict[str, str] = {}
    names: list[str] = []
    for line in paragraph.splitlines():
        match = ENTRY.match(line)
        if match:
            names = [name.lstrip("*") for name in match[1].split(", ")]
            found |= dict.fromkeys(names, match[2])
        elif names and line.startswith(" "):
            found |= {name: f"{found[name]} {line.strip()}" for name in names}
        else:
            return {}
    found = {name: re.sub(r"  +", " ", text) for name, text in found.items()}
    return found if known & found.keys() else {}


def with_sections(docstring: griffe.Docstring, known: set[str], describe: Describe, rest: dict[str, str]) -> None:
    """Put a section in the place of the lists; `rest` are descriptions of names that none of them has."""
    sections: list[Any] = []
    described: dict[str, str] = {}
    place: int | None = None
    for paragraph in re.split(r"\n{2,}", docstring.value):
        found = entries(paragraph, known)
        if found:
            described |= found
            place = len(sections) if place is None else place
        else:
            sections.append(griffe.DocstringSectionText(paragraph))
    described |= {name: text for name, text in rest.items() if name not in described}
    if described:
        sections.insert(len(sections) if place is None else place, describe(described))
        docstring.__dict__["parsed"] = sections  # instead of what its parser finds


def comment(attribute: griffe.Attribute) -> str:
    """The comment of a setting, "" for any other field."""
    try:
        call = ast.parse(str(attribute.value), mode="eval").body
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id.startswith("setting"):
            text = ast.literal_eval(call.args[-1])
            return text if isinstance(text, str) else ""
    except (SyntaxError, ValueError, IndexError):
        pass
    return ""


class FieldTables(griffe.Extension):
    """Fields of classes and parameters of functions."""

    def on_class_members(self, *, cls: griffe.Class, **_: Any) -> None:
        """A table of the fields, or of the parameters of `__init__` that the docstring of the class lists."""
        fields = {
            name: member
            for name, member in cls.members.items()
            if isinstance(member, griffe.Attribute) and member.annotation is not None and not name.startswith("_")
        }
        is_dataclass = any(str(decorator.value).startswith("dataclass") for decorator in cls.decorators)
        rest = {name: comment(field) for name, field in fields.items()} if is_dataclass else {}
        properties = {name for name, member in cls.members.items() if isinstance(member, griffe.Attribute)}

        def attributes(found: dict[str, str]) -> Any:
            types = {name: getattr(cls.members.get(name), "annotation", None) for name in found}
            rows = [griffe.DocstringAttribute(n, annotation=types[n], description=text) for n, text in found.items()]
            return griffe.DocstringSectionAttributes(rows)

        if cls.docstring is not None:
            with_sections(cls.docstring, properties, attributes, rest)
            start = cls.members.get("__init__")
            if isinstance(start, griffe.Function) and "parsed" not in cls.docstring.__dict__:
                self._parameters(cls.docstring, start)

    def on_function_instance(self, *, func: griffe.Function, **_: Any) -> None:
        """A table of the parameters that the docstring lists."""
        if func.docstring is not None:
            self._parameters(func.docstring, func)

    def _parameters(self, docstring: griffe.Docstring, function: griffe.Function) -> None:
        known = {parameter.name: parameter for parameter in function.parameters}

        def parameters(found: dict[str, str]) -> Any:
            rows = []
            for name, text in found.items():
                one = known.get(name)
                kind = {} if one is None else {"annotation": one.annotation, "value": one.default}
                rows.append(griffe.DocstringParameter(name, description=text, **kind))
            return griffe.DocstringSectionParameters(rows)

        with_sections(docstring, set(known), parameters, {})

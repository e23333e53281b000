"""Detections and tracks as tables for a terminal and a notebook."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from typing import Any

from saga_fg.errors import MissingExtraError

LONGEST = 20
"""Rows that are shown."""


def html_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str | float | int]]) -> str:
    """Return a title and the first rows of a table; NaN is left empty."""
    head = "".join(f"<th>{html.escape(name)}</th>" for name in columns)
    body = "".join(f"<tr>{''.join(f'<td>{_cell(value)}</td>' for value in row)}</tr>" for row in rows[:LONGEST])
    more = f"<p>and {len(rows) - LONGEST} more</p>" if len(rows) > LONGEST else ""
    return f"<p>{html.escape(title)}</p><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{more}"


def text_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str | float | int]]) -> str:
    """Return the same for a terminal."""
    cells = [columns, *([_text(value) for value in row] for row in rows[:LONGEST])]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = ("  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True)) for row in cells)
    more = [f"and {len(rows) - LONGEST} more"] if len(rows) > LONGEST else []
    return "\n".join([title, *lines, *more])


def _text(value: str | float | int) -> str:
    if isinstance(value, float):
        return f"{value:.2f}" if value == value else ""
    return str(value)


def _cell(value: str | float | int) -> str:
    return html.escape(_text(value))


def data_frame(columns: Mapping[str, Any]) -> Any:
    """Return columns as a `pandas.DataFrame`. Raises `MissingExtraError` without pandas."""
    try:
        import pandas
    except ImportError as error:
        raise MissingExtraError("tables need pandas: pip install 'saga-fg[pandas]'") from error
    return pandas.DataFrame(columns)

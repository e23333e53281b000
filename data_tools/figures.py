"""Figures for people and programs: tables of texts, and JSON with null for undefined numbers."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.files.atomic_files import write_text


@dataclass(frozen=True)
class FigureTable:
    """A table of texts; the first column names the rows."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def markdown(self) -> str:
        """The table in Markdown, its title in bold above it."""
        lines = [self.columns, ("---", *("---:" for _ in self.columns[1:])), *self.rows]
        return f"**{self.title}**\n\n" + "".join(f"| {' | '.join(line)} |\n" for line in lines)


def cell(value: float, digits: int = 3) -> str:
    """A number as text: whole numbers as they are, others to so many digits, "-" if it is not finite."""
    if isinstance(value, int | np.integer):
        return str(int(value))
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def count(value: float) -> str:
    """A count as text, "-" if it is not finite."""
    return cell(value, 0)


def as_json(value: Any) -> Any:
    """Dataclasses, mappings, sequences, arrays and numbers as values of JSON: null for numbers that are not finite."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): as_json(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(part) for part in value]
    return value


def write_figures(path: str | Path, figures: Any) -> None:
    """Write figures as JSON, whole or not at all. Raises `InputError` for a path that is not writable."""
    write_text(path, json.dumps(as_json(figures), indent=1, allow_nan=False) + "\n")

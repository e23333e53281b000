"""Figures for people and programs: tables of texts, charts as numbers, and JSON with null for undefined numbers."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.files.atomic_files import write_text
from saga_fg.numerics.arrays import FloatArray


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


CURVE_POINTS = 100
FEWEST = 20  # values that make a curve


@dataclass(frozen=True)
class Series:
    """A curve, or the heights of bars; `faint`: the reference of the others."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    faint: bool = False


@dataclass(frozen=True)
class Chart:
    """Curves over common axes; with `bars`, the one series is drawn as bars from x[k] to x[k + 1]."""

    title: str
    x_label: str
    y_label: str
    series: Sequence[Series]
    bars: bool = False


def distribution(title: str, unit: str, share_of: str, samples: Sequence[tuple[str, FloatArray]]) -> Chart:
    """Return cumulative distributions up to the 99 % quantile, of the samples with enough values."""
    share = np.linspace(0.0, 0.99, CURVE_POINTS)
    series = [
        Series(name, np.quantile(values, share).tolist(), share.tolist())
        for name, values in samples
        if len(values) >= FEWEST
    ]
    return Chart(title, unit, share_of, series)


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

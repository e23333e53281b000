"""Figures as tables and as JSON."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_tools.figures import FigureTable, as_json, cell, count, write_figures


@dataclass
class Figure:
    name: str
    value: float


def test_cells() -> None:
    assert [cell(0.12345), cell(3), cell(np.int64(4)), cell(math.nan), cell(1.0, 1)] == ["0.123", "3", "4", "-", "1.0"]
    assert [count(3.0), count(math.nan)] == ["3", "-"]


def test_json_has_null_for_what_is_not_finite(tmp_path: Path) -> None:
    figures = {"a": Figure("x", math.nan), 0.5: (np.array([1.0, math.inf]), np.float64(2.0), np.int64(3)), "n": None}
    assert as_json(figures) == {"a": {"name": "x", "value": None}, "0.5": [[1.0, None], 2.0, 3], "n": None}
    write_figures(tmp_path / "f.json", figures)
    assert json.loads((tmp_path / "f.json").read_text()) == as_json(figures)


def test_markdown() -> None:
    table = FigureTable("speeds", ("method", "ms"), (("a", "1.0"), ("b", "-")))
    assert table.markdown() == "**speeds**\n\n| method | ms |\n| --- | ---: |\n| a | 1.0 |\n| b | - |\n"

"""Plots. Pictures: what is drawn is where the data say."""

import json
import math
from dataclasses import dataclass

import numpy as np

from data_tools.evaluation import recall_charts
from data_tools.figures import FigureTable, as_json, cell, count, write_figures
from data_tools.metrics import RecallCurves


def test_recall_charts_leave_out_what_is_not_reached():
    recall = np.linspace(1.0, 0.1, 10)
    reached = np.where(recall > 0.75, np.nan, 0.5)
    charts = recall_charts({"car": RecallCurves(recall, *([reached] * 8))})
    assert len(charts) == 4
    for chart in charts:
        (series,) = chart.series
        assert max(series.x) <= 0.75
        assert set(series.y) == {0.5}


# Figures as tables and as JSON


@dataclass
class Figure:
    name: str
    value: float


def test_cells_and_tables_of_them():
    assert [cell(0.12345), cell(3), cell(np.int64(4)), cell(math.nan), cell(1.0, 1)] == ["0.123", "3", "4", "-", "1.0"]
    assert [count(3.0), count(math.nan)] == ["3", "-"]
    table = FigureTable("speeds", ("method", "ms"), (("a", "1.0"), ("b", "-")))
    assert table.markdown() == "**speeds**\n\n| method | ms |\n| --- | ---: |\n| a | 1.0 |\n| b | - |\n"


def test_json_has_null_for_what_is_not_finite(tmp_path):
    figures = {"a": Figure("x", math.nan), 0.5: (np.array([1.0, math.inf]), np.float64(2.0), np.int64(3)), "n": None}
    assert as_json(figures) == {"a": {"name": "x", "value": None}, "0.5": [[1.0, None], 2.0, 3], "n": None}
    write_figures(tmp_path / "f.json", figures)
    assert json.loads((tmp_path / "f.json").read_text()) == as_json(figures)

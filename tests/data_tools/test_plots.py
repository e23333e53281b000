"""Plots. Pictures: what is drawn is where the data say."""

import json
import math
from dataclasses import dataclass

import numpy as np
import pytest

from data_tools.evaluation import recall_charts
from data_tools.figures import Chart, FigureTable, Series, as_json, cell, count, write_figures
from data_tools.metrics import RecallCurves
from data_tools.plots import chart_picture, png, running_graph_picture


def test_a_chart_is_drawn_as_it_is():
    chart = Chart(
        "Errors", "m", "share", [Series("right", (0, 1), (0, 1), faint=True), Series("car", (0, 2), (0, 0.5))]
    )
    figure = chart_picture([chart, chart])
    for ax in figure.axes:
        right, car = ax.lines
        assert (ax.get_title(), right.get_color(), car.get_label()) == ("Errors", "black", "car")
        assert car.get_xydata().tolist() == [[0, 0], [2, 0.5]]
    assert png(figure).startswith(b"\x89PNG")


def test_recall_charts_leave_out_what_is_not_reached():
    recall = np.linspace(1.0, 0.1, 10)
    reached = np.where(recall > 0.75, np.nan, 0.5)
    charts = recall_charts({"car": RecallCurves(recall, *([reached] * 8))})
    assert len(charts) == 4
    for chart in charts:
        (series,) = chart.series
        assert max(series.x) <= 0.75
        assert set(series.y) == {0.5}


def test_a_running_graph_is_drawn_where_it_is():
    car = {"name": "car 1 at 1.00 s", "kind": "object", "time": 1.0, "position": [20.0, 0.0]}
    nodes = [
        car | {"covariance": [[1, 0], [0, 4]]},
        car | {"name": "car 1 at 0.90 s", "time": 0.9, "position": [19.9, 0.0]},
        car | {"name": "car 2 at 0.90 s", "time": 0.9, "position": [40.0, 5.0]},
        {"name": "post 3", "kind": "landmark", "time": None, "position": [30.0, -9.0]},
    ]
    factors = [
        {"kind": "interaction", "nodes": [0, 1, 2], "edges": [["CarFollowing", 0.5]]},
        {"kind": "detection", "nodes": [0]},
    ]
    figure = running_graph_picture({"nodes": nodes, "factors": factors}, "a graph")
    (ax,) = figure.axes
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    factors_of = ["interaction factor", "detection factor", "car following"]
    assert labels == ["object at 1.00 s", "landmark", "earlier", *factors_of]
    assert [text.get_text() for text in ax.texts] == ["car 1", "post 3"]
    drawn = [line.get_xydata() for line in ax.lines]
    assert any(np.array_equal(line, [[20.0, 0.0]]) for line in drawn)
    ends = [line[-1].tolist() for line in drawn if len(line) == 2]
    assert [40.0, 5.0] in ends  # of the edge from car 2
    set_back = next(line[0] for line in drawn if len(line) == 1 and 10 < line[0][0] < 19.5)
    assert set_back[1] == pytest.approx(0.0)  # straight behind, where it can be seen
    (around,) = running_graph_picture({"nodes": nodes, "factors": factors}, centre=[20, 0], radius=5.0).axes
    assert around.get_xlim() == (15.0, 25.0)
    running_graph_picture({"nodes": [], "factors": []})


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

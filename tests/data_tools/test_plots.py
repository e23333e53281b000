"""Pictures: what is drawn is where the data say."""

from __future__ import annotations

import numpy as np
import pytest

from data_tools.metrics import LabelErrors, RecallCurves
from data_tools.plots import (
    calibration_plot,
    error_histograms,
    png,
    recall_sweep,
    running_graph_picture,
)


def label_errors(nees: np.ndarray) -> LabelErrors:
    n = len(nees)
    column = np.linspace(0.0, 1.0, n)
    return LabelErrors(
        np.full(n, "car"), np.arange(n), column, np.ones(n, dtype=bool), column / 2, column, column, column, nees
    )


def test_calibration_follows_the_diagonal_where_covariances_are_right() -> None:
    nees = np.random.default_rng(0).chisquare(2, 4000)
    (ax,) = calibration_plot(label_errors(nees)).axes
    line = next(line for line in ax.lines if str(line.get_label()).startswith("car"))
    np.testing.assert_allclose(line.get_ydata(), line.get_xdata(), atol=0.03)
    (ax,) = calibration_plot(label_errors(nees / 4)).axes  # covariances too large
    assert (ax.lines[0].get_ydata() >= ax.lines[0].get_xdata()).all()
    assert len(calibration_plot(label_errors(np.full(5, np.nan))).axes[0].lines) == 1  # the diagonal alone


def test_error_histograms_are_cumulative_and_show_the_detections() -> None:
    figure = error_histograms(label_errors(np.ones(1000)))
    position, velocity, heading = figure.axes
    overall, detections = (line for line in position.lines if line.get_color() == "C0")
    x, y = overall.get_data()
    np.testing.assert_allclose(y, np.minimum(x, 1.0), atol=0.01)
    np.testing.assert_allclose(detections.get_ydata(), np.minimum(2 * x, 1.0), atol=0.02)
    assert len(velocity.lines) == len(heading.lines) == 2


def test_recall_sweeps_leave_out_what_is_not_reached() -> None:
    recall = np.linspace(1.0, 0.1, 10)
    reached = np.where(recall > 0.75, np.nan, 0.5)
    curves = RecallCurves(recall, *([reached] * 8))
    figure = recall_sweep({"car": curves})
    assert len(figure.axes) == 4
    for ax in figure.axes:
        (line,) = ax.lines
        assert max(line.get_xdata()) <= 0.75
        assert set(line.get_ydata()) == {0.5}
    assert png(figure).startswith(b"\x89PNG")


def test_a_running_graph_is_drawn_where_it_is() -> None:
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

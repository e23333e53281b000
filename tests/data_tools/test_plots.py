"""Pictures: what is drawn is where the data say."""

from __future__ import annotations

import numpy as np
import pytest

from data_tools.metrics import LabelErrors, RecallCurves
from data_tools.plots import (
    Panel,
    birds_eye_view,
    calibration_plot,
    error_histograms,
    png,
    recall_sweep,
    running_graph_picture,
)
from saga_fg import Annotations, Boxes, Detections, Tracks
from saga_fg.numerics.geometry import yaw_transform


def tracks(timestamp: float, x: float, coasting: float = 0.0) -> Tracks:
    boxes = Boxes.of(["car"], [[x, 5.0, 1.0]], [[4.0, 2.0, 1.5]], [0.0], [[3.0, 0.0]])
    P = np.diag([4.0, 1.0])[None]
    return Tracks(timestamp, np.array([7]), boxes, np.ones(1), P, P, np.array([coasting]))


def test_a_picture_shows_truth_detections_and_tracks_in_the_vehicles_frame() -> None:
    world_T_ego = yaw_transform(10.0, 0.0, 0.0, np.pi / 2)  # driving along y: ahead of it is +y
    now = tracks(0.0, 10.0, coasting=1.0)
    truth = Annotations(np.array(["a", "b"]), Boxes.concatenate([now.boxes, now.boxes]), np.array([True, False]))
    detections = Detections(now.boxes, np.ones(1))
    history = [tracks(-3.5, 8.0), tracks(-3.0, 9.0), now]
    figure = birds_eye_view([Panel("one", history)], world_T_ego, truth, detections)
    (ax,) = figure.axes
    assert ax.get_title(loc="left") == "one"
    lines = [np.column_stack(line.get_data()) for line in ax.lines]
    np.testing.assert_allclose(lines[0], [[5.0, 0.0]], atol=1e-9)  # the detection, 5 m ahead
    outline = lines[1]
    np.testing.assert_allclose(np.abs(outline - [5.0, 0.0]).max(axis=0), [1.0, 2.0], atol=1e-9)  # turned by a quarter
    np.testing.assert_allclose(lines[2], [[5.0, 1.0], [5.0, 0.0]], atol=1e-9)  # its path of the last 3 s
    ellipse = lines[3] - [5.0, 0.0]
    np.testing.assert_allclose(np.abs(ellipse).max(axis=0), np.sqrt(5.991 * np.array([1.0, 4.0])), rtol=2e-3)
    assert [patch.get_hatch() for patch in ax.patches[1:3]] == [None, "////"]
    assert png(figure, dpi=40).startswith(b"\x89PNG\r\n")


def test_unknown_sizes_and_headings_are_drawn_as_a_square() -> None:
    boxes = Boxes.of(["object"], [[3.0, 0.0, 0.0]])
    none = np.zeros((1, 2, 2))
    now = Tracks(0.0, np.array([1]), boxes, np.ones(1), none, none, np.zeros(1))
    figure = birds_eye_view([Panel("a", [now]), Panel("b", [Tracks.empty(0.0)])], np.eye(4))
    first, second = figure.axes
    assert np.ptp(first.lines[0].get_xdata()) == 1.0
    assert len(second.lines) == 0


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

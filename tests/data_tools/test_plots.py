"""Pictures: what is drawn is where the data say."""

from __future__ import annotations

import numpy as np

from data_tools.plots import Panel, birds_eye_view, png, trails
from saga_fg import Annotations, Boxes, Detections, Tracks
from saga_fg.geometry import yaw_transform


def tracks(timestamp: float, x: float, coasting: float = 0.0) -> Tracks:
    boxes = Boxes.of(["car"], [[x, 5.0, 1.0]], [[4.0, 2.0, 1.5]], [0.0], [[3.0, 0.0]])
    P = np.diag([4.0, 1.0])[None]
    return Tracks(timestamp, np.array([7]), boxes, np.ones(1), P, P, np.array([coasting]))


def test_trails_reach_back_as_far_as_asked() -> None:
    history = [tracks(k / 2, float(k)) for k in range(9)]
    (trail,) = trails(history, duration=1.0).values()
    np.testing.assert_allclose(trail, [[6, 5], [7, 5], [8, 5]])


def test_a_picture_shows_truth_detections_and_tracks_in_the_vehicles_frame() -> None:
    world_T_ego = yaw_transform(10.0, 0.0, 0.0, np.pi / 2)  # driving along y: ahead of it is +y
    now = tracks(0.0, 10.0, coasting=1.0)
    truth = Annotations(np.array(["a", "b"]), Boxes.concatenate([now.boxes, now.boxes]), np.array([True, False]))
    detections = Detections(now.boxes, np.ones(1))
    figure = birds_eye_view(
        [Panel("one", now, {7: np.array([[10.0, 0.0], [10.0, 5.0]])})], world_T_ego, truth, detections
    )
    (ax,) = figure.axes
    assert ax.get_title(loc="left") == "one"
    lines = [np.column_stack(line.get_data()) for line in ax.lines]
    np.testing.assert_allclose(lines[0], [[5.0, 0.0]], atol=1e-9)  # the detection, 5 m ahead
    outline = lines[1]
    np.testing.assert_allclose(np.abs(outline - [5.0, 0.0]).max(axis=0), [1.0, 2.0], atol=1e-9)  # turned by a quarter
    np.testing.assert_allclose(lines[2], [[0.0, 0.0], [5.0, 0.0]], atol=1e-9)  # where it came from
    ellipse = lines[3] - [5.0, 0.0]
    np.testing.assert_allclose(np.abs(ellipse).max(axis=0), np.sqrt(5.991 * np.array([1.0, 4.0])), rtol=2e-3)
    assert [patch.get_hatch() for patch in ax.patches[1:3]] == [None, "////"]
    assert png(figure, dpi=40).startswith(b"\x89PNG\r\n")


def test_unknown_sizes_and_headings_are_drawn_as_a_square() -> None:
    boxes = Boxes.of(["object"], [[3.0, 0.0, 0.0]])
    none = np.zeros((1, 2, 2))
    now = Tracks(0.0, np.array([1]), boxes, np.ones(1), none, none, np.zeros(1))
    figure = birds_eye_view([Panel("a", now, {}), Panel("b", Tracks.empty(0.0), {})], np.eye(4))
    first, second = figure.axes
    assert np.ptp(first.lines[0].get_xdata()) == 1.0
    assert len(second.lines) == 0

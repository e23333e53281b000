"""`plot`: tracks from above."""

from __future__ import annotations

import pytest

from data_tools.plots import plot, png
from saga_fg import Detection, Detections, Frame, InputError, Tracker, track


def some_tracks():
    tracker = Tracker()
    cars = [Detections.of([Detection("car", (k * 1.0, 3.0 * n, 0.0)) for n in range(3)]) for k in range(6)]
    return [tracker.step(Frame(k / 10, "lidar", found)) for k, found in enumerate(cars)], cars[-1]


def test_each_track_has_a_path_and_a_box() -> None:
    history, detections = some_tracks()
    (ax,) = plot(history, detections).axes
    assert len(ax.lines) == 4  # with the detections
    assert len(ax.patches) == 3
    assert sorted(text.get_text() for text in ax.texts) == ["1", "2", "3"]
    assert ax.lines[1].get_xdata()[-1] == pytest.approx(5, abs=0.3)
    assert png(plot(history[-1], ids=False)).startswith(b"\x89PNG")
    assert not plot([]).axes[0].lines


def test_the_table_of_the_one_line_tracker_is_drawn() -> None:
    pd = pytest.importorskip("pandas", reason="pandas comes with the extra pandas")
    rows = pd.DataFrame([{"timestamp": k / 10, "x": k * 1.0, "y": 3.0 * n} for k in range(6) for n in range(2)])
    (ax,) = plot(track(rows)).axes
    assert len(ax.patches) == 2


def test_anything_else_is_refused() -> None:
    with pytest.raises(InputError, match="got str"):
        plot("tracks.csv")

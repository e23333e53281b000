"""The picture of a gap on a road with lanes, stop lines and lights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import to_hex

from benchmarks.gaps.contenders import contenders
from benchmarks.gaps.picture import LIGHTS, drawn_gap, gap_picture, telling_gap
from pipelines.config import load_config
from pipelines.learning.gap_runs import run_of
from saga_fg import InputError
from saga_fg.types.road_map import Lane
from tests.pipelines.test_situations import GAP, ROAD, STEADY, along, labelled

GAPS = [replace(GAP, run=1)]
KF = contenders("file")["kf"].contender(load_config("file"))


def test_lanes_and_stop_lines_are_drawn_in_the_colours_of_their_lights() -> None:
    road = replace(ROAD, lanes=(Lane("lane", ((-50.0, 0.0), (80.0, 0.0))),))
    for colour in ("red", "green", None):
        scene = labelled({"a": STEADY, "b": along(STEADY[:, 0] + 8)}, colour=colour, road=road)
        (ax,) = gap_picture(scene, GAPS[0], [drawn_gap(scene, GAPS, GAPS[0], KF, "kept")]).axes
        wide = [to_hex(line.get_color()) for line in ax.lines if line.get_linewidth() == 3.0]
        assert LIGHTS.get(colour or "", "#808080") in wide
        assert ax.get_xlim()[1] > 33.0, "the line is 30 m ahead of where the way begins"
        assert any(np.ptp(line.get_xdata()) == pytest.approx(130.0) for line in ax.lines), "the lane"


def test_a_track_breaks_off_where_the_object_returns_and_the_legend_tells_all() -> None:
    scene = labelled({"a": STEADY, "b": along(STEADY[:, 0] + 8)})
    figure = gap_picture(scene, GAPS[0], [drawn_gap(scene, GAPS, GAPS[0], KF, "kept")])
    (track,) = [line for line in figure.axes[0].lines if line.get_marker() == "o"]
    assert np.isnan(track.get_xdata()).sum() == 1
    told = {text.get_text() for text in figure.legends[0].get_texts()}
    assert {"detections then", "track N, a colour each; ring: 90 % ellipse"} <= told


def test_the_gap_may_be_chosen_by_situation() -> None:
    scene = labelled({"a": STEADY}, colour="red")
    run = run_of(scene, GAPS, KF, "kept")
    assert telling_gap([run], [run], ("at red",)) == ("drawn", GAPS[0])
    with pytest.raises(InputError, match="expected recordings with gaps of objects starting, there are none"):
        telling_gap([run], [run], ("starting",))

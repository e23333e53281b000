"""The benchmark of two sensors: what its groups hold, and that its command runs from end to end."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.app import app
from benchmarks.fusion import GROUPS, LIDAR, fusion_figures, judge
from data_tools.simulator import SimulatorSettings, lidar
from data_tools.simulator.scenarios import scenario_settings
from saga_fg import Annotations, Boxes, Detections, Frame, Scene
from saga_fg.types.track import Tracks

SETTINGS = scenario_settings("two-sensors")
PLACES = [[20.0, 0.0, 1.0], [90.0, 0.0, 1.0], [50.0, 10.0, 0.9]]
LABELS = ["car", "car", "pedestrian"]
SIZES = [[4.5, 1.8, 1.6], [4.5, 1.8, 1.6], [0.65, 0.65, 1.72]]


def scene_with_an_outage() -> Scene:
    """A near car, a far car and a far person; the LiDAR has a frame at the first of two moments only."""
    boxes = Boxes.of(LABELS, PLACES, SIZES, [0.0] * 3)
    truth = Annotations(np.array(["near", "far", "person"]), boxes, np.ones(3, dtype=np.bool_))
    none = Detections(Boxes.empty(), np.empty(0))
    frames = (Frame(0.0, LIDAR, none, np.eye(4)), Frame(0.5, "far_camera", none, np.eye(4)))
    return Scene("one", np.array([0.0, 0.5]), np.tile(np.eye(4), (2, 1, 1)), ("", ""), frames, (truth, truth))


def tracks(time: float, *rows: int) -> Tracks:
    boxes, n = Boxes.of(LABELS, PLACES, SIZES, [0.0] * 3).select(list(rows)), len(rows)
    eye = np.tile(np.eye(2), (n, 1, 1))
    return Tracks(time, np.array(rows) + 1, boxes, np.full(n, 0.9), eye, eye, np.zeros(n))


def test_objects_are_counted_in_the_group_that_the_lidar_puts_them_in() -> None:
    judged = judge(scene_with_an_outage(), [tracks(0.0, 0, 1), tracks(0.5, 0)], SETTINGS)
    groups = dict(zip((*GROUPS, "all"), judged.tracked.tolist(), strict=True))
    assert groups == {"in outages": [1, 2], "beyond range": [1, 2], "small": [0, 1], "all": [3, 6]}
    figures = fusion_figures([judged, judged], 100.0)
    assert figures["all"] == 0.5
    assert figures["false boxes"] == 0
    assert figures["position RMSE"] == 0


def test_the_sensors_of_the_scenario_have_settings_of_the_tracker() -> None:
    from pipelines.config import load_config

    assert set(SETTINGS.sensors) <= set(load_config("simulated").sensors)
    assert replace(SimulatorSettings(), sensors={"lidar": lidar()}).sensors["lidar"].resolution is None


def test_the_command_prints_all_contenders_and_writes_its_figures(tmp_path: Path) -> None:
    file = tmp_path / "figures.json"
    arguments = ["fusion", "--scenes", "2", "--duration", "3", "--draws", "5", "--json", str(file)]
    result = CliRunner(env={"COLUMNS": "250"}).invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "both less LiDAR" in result.output
    figures = json.loads(file.read_text())
    both, alone = (figures["figures"][name]["all"] for name in ("both", "LiDAR"))
    assert figures["both less LiDAR"]["all"]["estimate"] == pytest.approx(both - alone)

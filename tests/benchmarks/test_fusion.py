"""The benchmark of fusion: what it counts as surviving a gap, and its command from end to end."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from benchmarks.app import app
from benchmarks.fusion import of_sensors, survived, without
from saga_fg import Annotations, Boxes, Detections, Frame, Scene, Sensor, Tracks
from saga_fg.types.sensor import FieldOfView

TIMES = np.arange(0.0, 10.0)
PLACES = {"a": (10.0, 0.0), "b": (20.0, 0.0), "behind": (-10.0, 0.0), "hidden": (30.0, 5.0)}


def scene() -> Scene:
    """Four objects that stand still; `behind` is out of the camera's view, `hidden` cannot be seen in the gap."""
    position = np.array([(*place, 1.0) for place in PLACES.values()])
    boxes = Boxes.of(["car"] * 4, position)
    truth = [
        Annotations(np.array(list(PLACES)), boxes, np.array([True, True, True, not 4 <= k <= 5])) for k in range(10)
    ]
    frames = [Frame(t, name, Detections.empty()) for t in TIMES for name in ("lidar", "camera")]
    return Scene("still", TIMES, np.tile(np.eye(4), (10, 1, 1)), ("",) * 10, frames, truth)


def tracks(ids: list[int], timestamp: float) -> Tracks:
    position = np.array([(*place, 1.0) for place in PLACES.values()])
    covariance = np.tile(np.eye(2), (4, 1, 1))
    boxes = Boxes.of(["car"] * 4, position, velocity=np.zeros((4, 2)))
    return Tracks(timestamp, np.array(ids), boxes, np.ones(4), covariance, covariance, np.zeros(4))


def test_an_object_survives_with_its_identity_or_not_at_all() -> None:
    before, after = [1, 2, 3, 4], [1, 7, 3, 4]
    history = [tracks(before if t < 5 else after, t) for t in TIMES]
    front = {"camera": Sensor(field_of_view=FieldOfView(-1.0, 1.0, 50.0))}
    assert survived(scene(), history, front, 3.0).tolist() == [True, False]  # a kept its track, b has a new one


def test_the_gap_silences_one_sensor() -> None:
    kept = without(scene(), "lidar", 3.0)
    assert [f.timestamp for f in kept.frames if f.sensor == "lidar"] == [0, 1, 2, 3, 7, 8, 9]
    assert sum(f.sensor == "camera" for f in kept.frames) == 10
    assert of_sensors(kept, ("camera",)).sensors == ("camera",)


def test_the_command_compares_and_writes_its_figures(tmp_path: Path) -> None:
    short, file = tmp_path / "short.yaml", tmp_path / "figures.json"
    short.write_text("duration: 4.0\nkeyframe_rate: 5.0\n")
    arguments = ["fusion", "--scenes", "2", "--method", "kf", "--gap", "1", "--simulator", str(short)]
    result = CliRunner().invoke(app, [*arguments, "--json", str(file)])
    assert result.exit_code == 0, result.output
    assert "both against lidar alone" in result.output
    figures = json.loads(file.read_text())
    assert set(figures["amota"]) == {"lidar", "camera", "both", "both and a poor one"}
    gain = figures["gain"]
    assert abs(gain["estimate"] - (figures["amota"]["both"] - figures["amota"]["lidar"])) < 1e-9
    assert gain["low"] <= gain["estimate"] <= gain["high"]

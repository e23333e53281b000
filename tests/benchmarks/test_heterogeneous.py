"""The benchmark of heterogeneous graphs: its questions, its baselines, its figures."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.app import app
from benchmarks.heterogeneous import _figures, cars_alone, contenders, tables
from benchmarks.predictions import prediction_errors
from data_tools.simulator import SimulatorSettings, simulate_scene
from pipelines.config import load_config
from saga_fg import Detection, Detections, Frame
from saga_fg.types.track import Tracks


class Clairvoyant:
    """Tracks that are the truth of the moment, moved on at their present velocity."""

    def __init__(self, scene):
        self._scene, self._taken = scene, -np.inf

    def step(self, frame):
        self._taken = frame.timestamp
        return self.tracks(frame.timestamp)

    def tracks(self, timestamp):
        assert self._taken >= self._scene.timestamps[0]
        row = int(np.flatnonzero(self._scene.timestamps <= self._taken + 1e-6)[-1])
        truth, ahead = self._scene.ground_truth[row], timestamp - self._scene.timestamps[row]
        n, P = len(truth), np.tile(np.eye(2), (len(truth), 1, 1))
        moved = truth.boxes.position + np.pad(truth.boxes.velocity * ahead, ((0, 0), (0, 1)))
        boxes = type(truth.boxes)(truth.boxes.label, moved, truth.boxes.size, truth.boxes.yaw, truth.boxes.velocity)
        return Tracks(timestamp, np.arange(n), boxes, np.ones(n), P, P, np.zeros(n))


def test_predictions_know_nothing_of_the_time_after():
    """The error of a tracker that knows all of the present is that of going straight on."""
    scene = simulate_scene(SimulatorSettings(duration=4.0, warm_up=5.0), 1)
    everybody = {row: scene.ground_truth[row].id for row in (10, 15)}
    errors = prediction_errors(scene, Clairvoyant(scene), 2.0, [10, 15], everybody.__getitem__)
    assert len(errors) > 10
    for (name, row), error in errors.items():
        now, then = scene.ground_truth[row], scene.ground_truth[row + 20]
        a, b = (np.flatnonzero(moment.id == name)[0] for moment in (now, then))
        assert now.visible[a]
        straight = now.boxes.position[a, :2] + 2.0 * now.boxes.velocity[a] - then.boxes.position[b, :2]
        assert error == pytest.approx(np.hypot(*straight), abs=0.15)  # the frame came up to a tenth of a second before


def test_the_baselines_differ_in_their_edges():
    found = contenders(load_config("heterogeneous"))
    kinds = {name: [type(edge).__name__ for edge in config.tracker.edges] for name, config in found.items()}
    assert set(kinds["full"]) == {"RedLight", "InLane", "ConeLine", "Following", "Attached", "Neighbours"}
    assert set(kinds["cars"]) == {"Following", "Neighbours"}
    assert kinds["kf"] == []
    assert cars_alone(found["full"]).tracker.classes == found["full"].tracker.classes
    assert all(edge.cones is None for edge in found["cars"].tracker.edges if type(edge).__name__ == "Following")


def test_a_bicycle_is_not_expected_to_speed_up_behind_a_car():
    """It rides at 5 m/s, 6 m behind a car at 8 m/s, and is predicted to go on as it does."""
    tracker = load_config("heterogeneous").new_tracker("saga")
    for k in range(30):
        car = Detection("car", (5.75 + 0.8 * k, 0.0, 0.8), (4.5, 1.8, 1.5), 0.0, (8.0, 0.0), score=0.9)
        bicycle = Detection("bicycle", (0.5 * k, 0.0, 0.6), (1.75, 0.6, 1.1), 0.0, (5.0, 0.0), score=0.9)
        tracker.step(Frame(k / 10, "lidar", Detections.of([car, bicycle])))
    (rider,) = (track for track in tracker.tracks(2.9 + 2.0) if track.label == "bicycle")
    assert rider.velocity[0] == pytest.approx(5.0, abs=0.3)


def test_figures_are_pooled_over_scenes():
    half = {"full": [1.0, 2.0], "cars": [2.0, 4.0], "shipped": [2.0, 4.0], "kf": [4.0, 8.0]}
    figures = _figures([half, half, {name: [] for name in half}])
    assert figures.count == 4
    assert figures.mean["full"] == 1.5
    assert figures.change["cars"].estimate == pytest.approx(-0.5)
    assert (figures.change["kf"].low, figures.change["kf"].high) == pytest.approx((-0.75, -0.75))


def test_the_command_prints_and_writes_its_figures(tmp_path):
    path = tmp_path / "figures.json"
    options = ["--kinds", "road-works", "--scenes", "2", "--duration", "5", "--json", str(path)]
    result = CliRunner().invoke(app, ["heterogeneous", *options])
    assert result.exit_code == 0, result.output
    assert "road-works" in result.output
    (kind,) = json.loads(path.read_text())
    assert kind["seeds"] == [0, 1]
    assert kind["groups"]["others"]["count"] > 0
    assert set(kind["groups"]["others"]["mean"]) == {"full", "cars", "shipped", "kf", "floor"}
    assert kind["groups"]["others"]["floor"]["estimate"] < 0


def test_an_unknown_kind_is_refused():
    result = CliRunner().invoke(app, ["heterogeneous", "--kinds", "blue-light"])
    assert result.exit_code != 0
    assert "blue-light" in result.output
    assert tables([]) == []

"""Scenes of more than cars as files: what is written is what was simulated, and it can be tracked."""

import csv
from dataclasses import replace

import numpy as np
from typer.testing import CliRunner

from data_tools.datasets.detection_files import read_detections
from data_tools.simulator import SimulatedTraffic
from data_tools.simulator.settings import scenario_settings
from pipelines.cli import app
from pipelines.config import load_config


def run(*arguments):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    return result.output


def test_a_red_light_scene_goes_to_files_and_back(tmp_path):
    short = tmp_path / "short.yaml"
    short.write_text("duration: 1.5\nwarm_up: 4.0\n")
    out = tmp_path / "junctions"
    assert "1 scene of 1.5 s" in run("simulate", "-o", out, "--scenario", "red-light", "--scenes", 1, "--config", short)
    folder = out / "scene-0001"
    settings = replace(scenario_settings("red-light"), duration=1.5, warm_up=4.0)
    scene = SimulatedTraffic(settings, 1, 0).scene("scene-0001")
    read = read_detections(folder / "detections.csv").scene("scene-0001")
    assert [(frame.timestamp, frame.sensor) for frame in read.frames] == [(f.timestamp, f.sensor) for f in scene.frames]
    for got, made in zip(read.frames, scene.frames, strict=True):
        assert got.detections.boxes.label.tolist() == made.detections.boxes.label.tolist()
        for name in ("position", "size", "yaw", "velocity"):
            assert np.array_equal(
                getattr(got.detections.boxes, name), getattr(made.detections.boxes, name), equal_nan=True
            )
        assert np.allclose(got.world_T_ego, made.world_T_ego)
    assert any(label.startswith("traffic_light") for f in read.frames for label in f.detections.boxes.label.tolist())
    with (folder / "truth.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == sum(len(moment) for moment in scene.ground_truth)
    assert sum(int(row["visible"]) for row in rows) == sum(int(moment.visible.sum()) for moment in scene.ground_truth)

    written = load_config("file", folder / "settings.yaml")
    assert written.tracker.road_map == scene.frames[0].road_map
    assert written.tracker.edges == load_config("heterogeneous").tracker.edges
    tracks = tmp_path / "tracks.csv"
    run("track", "file", folder / "detections.csv", "--config", folder / "settings.yaml", "--output", tracks)
    assert len(tracks.read_text().splitlines()) > 10

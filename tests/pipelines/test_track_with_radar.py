"""Gain of the range rate of a radar for the velocity of tracks, on simulated traffic."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from data_tools.datasets.detection_files import read_detections, read_tracks
from data_tools.metrics import root_mean_square, scene_metrics
from data_tools.simulator import SimulatorSettings, lidar, radar, simulate_scene
from pipelines.cli import app
from pipelines.config import TrackConfig, load_config
from pipelines.tracking import track_scene
from saga_fg.errors import InputError
from saga_fg.types.dataset import Scene

SEEDS = range(500, 506)
TRAFFIC = SimulatorSettings(duration=6.0, sensors={"lidar": lidar(), "radar": radar()})


def lidar_alone(scene: Scene) -> Scene:
    """The scene without the frames of other sensors."""
    return replace(scene, frames=tuple(frame for frame in scene.frames if frame.sensor == "lidar"))


def square_sums(scene: Scene, config: TrackConfig) -> tuple[float, float]:
    """(sum of squares, number) of the velocity errors of matched visible objects."""
    tracks = track_scene(scene, config.new_tracker("saga")).tracks
    assert scene.ground_truth is not None
    return scene_metrics(scene.ground_truth, tracks).velocity.square_sums


def test_range_rates_make_velocities_better_than_the_radars_positions_do() -> None:
    """In the mean over scenes: single false matches tell more than that in some."""
    config = load_config("simulated")
    blind = replace(config.sensors["radar"], use_velocity=False)
    deaf = replace(config, sensors={**config.sensors, "radar": blind})
    scenes = [simulate_scene(TRAFFIC, seed) for seed in SEEDS]
    both = np.array([square_sums(s, config) for s in scenes])
    alone = np.array([square_sums(lidar_alone(s), config) for s in scenes])
    positions = np.array([square_sums(s, deaf) for s in scenes])
    assert root_mean_square(both.sum(axis=0)) < root_mean_square(positions.sum(axis=0))
    assert root_mean_square(both.sum(axis=0)) < root_mean_square(alone.sum(axis=0))


def test_a_table_with_range_rates_ends_in_tracks_that_move_along_the_line_of_sight(tmp_path: Path) -> None:
    table = tmp_path / "radar.csv"
    table.write_text(
        "timestamp,sensor,label,x,y,range_rate,ego_x,ego_y,ego_yaw\n"
        "0.0,radar,car,30.0,0.0,-8.0,0,0,0\n"
        "0.1,radar,car,30.4,0.1,-8.1,1,0,0\n"
        "0.1,lidar,car,29.2,0.0,,1,0,0\n"
    )
    found = CliRunner().invoke(app, ["track", "file", str(table), "--output", str(tmp_path / "tracks.csv")])
    assert found.exit_code == 0, found.output
    assert read_tracks(tmp_path / "tracks.csv").boxes.velocity[-1, 0] < -5.0


def test_a_table_with_range_rates_but_no_poses_is_refused(tmp_path: Path) -> None:
    table = tmp_path / "radar.csv"
    table.write_text("timestamp,x,y,range_rate\n0.0,30.0,0.0,-8.0\n")
    with pytest.raises(InputError, match=r"radar.csv: scene radar: world_T_ego: expected a pose, since range_rate"):
        read_detections(table).scene("radar")

"""Objects without a detector, tracked; and the benchmark of the LiDAR geometry."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from benchmarks.app import app
from data_tools.simulator.scanner import ScannerSettings
from data_tools.simulator.street import SimulatedScans, street
from pipelines.config import load_config
from pipelines.detector_free import cluster_scene
from pipelines.tracking import track_scene


def test_clusters_of_parked_cars_become_standing_tracks() -> None:
    scene = cluster_scene("street", SimulatedScans(0, 8, settings=ScannerSettings(columns=500)))
    assert scene.sensors == ("lidar",)
    tracks = track_scene(scene, load_config("file").new_tracker("saga")).tracks[-1]
    cars = street(0).boxes
    cars = cars.select((cars.label == "car") & (np.abs(cars.position[:, 0]) < 15))
    rows = tracks.boxes.label == "car"
    distance = np.linalg.norm(cars.position[:, None, :2] - tracks.boxes.position[rows][None, :, :2], axis=2)
    nearest = distance.argmin(axis=1)[distance.min(axis=1) < 1.0]
    assert len(nearest) >= 0.6 * len(cars)
    assert np.median(np.hypot(*tracks.boxes.velocity[rows][nearest].T)) < 1.5


def test_bench_lidar_prints_every_function_and_the_scores(recordings: Path) -> None:
    result = CliRunner().invoke(app, ["lidar", "--dataroot", str(recordings / "kitti"), "--scans", "6"])
    assert result.exit_code == 0, result.output
    for name in ("ground", "walls", "poles", "curbs", "objects", "clusters: recall", "tracks of the clusters: recall"):
        assert name in result.stdout
    assert "6 labels of 1 vehicles" in result.stdout


def test_bench_lidar_refuses_a_reach_that_is_none(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["lidar", "--dataroot", str(tmp_path), "--reach", "0"])
    assert result.exit_code == 2
    assert "expected a distance > 0 m" in result.stderr

"""`saga-fg smooth`, as a user calls it."""

from __future__ import annotations

import csv
import json
from pathlib import Path

from typer.testing import CliRunner

from data_tools.datasets.detection_files import read_tracks
from data_tools.datasets.nuscenes import write_nuscenes
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from pipelines.cli import app
from pipelines.config import Family
from pipelines.configuration import read_settings, write_settings
from pipelines.smoothing import SmoothConfig, load_smooth_config

runner = CliRunner()


def test_shipped_settings_survive_the_round_trip() -> None:
    families: tuple[Family, ...] = ("nuscenes", "kitti", "simulated", "traffic", "file")
    for family in families:
        config = load_smooth_config(family)
        assert read_settings(SmoothConfig, write_settings(config)) == config


def test_nuscenes_labels_are_complete(tmp_path: Path) -> None:
    traffic = SimulatedTraffic(SimulatorSettings(duration=5.0), scenes=1, seed=3)
    write_nuscenes(tmp_path / "data", traffic, traffic.mounts)
    detections = tmp_path / "data" / "detections" / "lidar.json"
    arguments = ["smooth", "nuscenes", "--dataroot", str(tmp_path / "data"), "--split", "all"]
    run = runner.invoke(app, [*arguments, "--detections", f"lidar={detections}", "-o", str(tmp_path / "labels")])
    assert run.exit_code == 0, run.output
    assert "observed" in run.output
    written = {path.name for path in (tmp_path / "labels").iterdir()}
    assert written == {"labels.csv", "summary.json", "tracking.json", "v1.0-mini", "maps"}
    rows = read_tracks(tmp_path / "labels" / "labels.csv", labels=True)
    summary = json.loads((tmp_path / "labels" / "summary.json").read_text())["total"]
    assert len(rows.source) == summary["observed"] + summary["filled"] + summary["extended"] > 0
    annotations = json.loads((tmp_path / "labels" / "v1.0-mini" / "sample_annotation.json").read_text())
    assert len(annotations) == len(rows.source)


def test_own_tables_become_labels_with_gaps_filled(tmp_path: Path) -> None:
    table = tmp_path / "detections.csv"
    with table.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["timestamp", "x", "y", "length", "width", "height", "yaw", "label", "score"])
        for k in range(20):
            there = [0.1 * k, 1.0 * k, 0.0, 4.5, 1.9, 1.6, 3.14159 * (k % 2), "car", 0.9]
            writer.writerow(there if k not in (8, 9) else [0.1 * k, *[""] * 8])
    run = runner.invoke(app, ["smooth", "file", str(table), "-o", str(tmp_path / "labels")])
    assert run.exit_code == 0, run.output
    rows = read_tracks(tmp_path / "labels" / "labels.csv", labels=True)
    assert rows.source.tolist() == ["filled" if k in (8, 9) else "observed" for k in range(20)]
    assert abs(rows.boxes.yaw).max() < 0.1  # flipped detections, and the car drives along x
    assert abs(rows.boxes.position[8, 0] - 8.0) < 0.2


def test_an_output_that_cannot_be_written_is_found_before_the_work(tmp_path: Path) -> None:
    run = runner.invoke(app, ["smooth", "simulated", "-o", str(tmp_path / "missing" / "labels")])
    assert run.exit_code == 2
    assert "does not exist" in run.stderr


def test_labels_are_judged_beside_online_tracks_and_detections(tmp_path: Path) -> None:
    run = runner.invoke(app, ["smooth", "simulated", "--scenes", "1", "--seed", "9", "-o", str(tmp_path / "labels"),
                              "--simulator", str(_short(tmp_path)), "--method", "kf"])  # fmt: skip
    assert run.exit_code == 0, run.output
    arguments = ["evaluate", "labels", "simulated", str(tmp_path / "labels"), "--seed", "9"]
    run = runner.invoke(app, [*arguments, "--simulator", str(_short(tmp_path)), "--method", "kf"])
    assert run.exit_code == 0, run.output
    for title in ("Precision and recall", "by class", "by range", "by occlusion", "Calibration", "Self-consistency"):
        assert title in run.output


def test_labels_of_a_file_are_judged_without_truth(tmp_path: Path) -> None:
    table = tmp_path / "detections.csv"
    rows = [f"{0.1 * k:.1f},{k}.0,0.0,4.5,1.9,1.6,0.0,car,0.9" for k in range(15)]
    table.write_text("timestamp,x,y,length,width,height,yaw,label,score\n" + "\n".join(rows) + "\n")
    run = runner.invoke(app, ["smooth", "file", str(table), "-o", str(tmp_path / "labels")])
    assert run.exit_code == 0, run.output
    figures = tmp_path / "figures.json"
    labels = ["evaluate", "labels", "file", str(tmp_path / "labels")]
    run = runner.invoke(app, [*labels, "--detections", str(table), "--json", str(figures)])
    assert run.exit_code == 0, run.output
    found = json.loads(figures.read_text())
    assert found["precision_recall"] == {}
    assert found["consistency"]["labels"]["boxes"] == 15
    assert found["consistency"]["labels"]["jerkiness"] < 1.0
    run = runner.invoke(app, ["evaluate", "labels", "file", str(tmp_path / "nothing"), "--detections", str(table)])
    assert run.exit_code == 2
    assert "expected a folder that `saga-fg smooth` wrote" in run.stderr


def _short(folder: Path) -> Path:
    path = folder / "simulator.yaml"
    path.write_text("duration: 3.0\n")
    return path

"""`python -m benchmarks slam` on drives: cost of keyframes, and of scans all in."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from benchmarks.app import app
from benchmarks.slam_all_in import bench_all_in
from data_tools.simulator.street import SimulatedScans


def test_a_drive_is_measured_and_stays_small(tmp_path: Path) -> None:
    outcome = CliRunner().invoke(app, ["slam", "--drive", "120", "--json", str(tmp_path / "f.json")])
    assert outcome.exit_code == 0, outcome.output
    assert "last lap to first one:" in outcome.stdout
    text = (tmp_path / "f.json").read_text()
    (row,) = json.loads(text)["rows"] if "rows" in json.loads(text) else json.loads(text)
    assert row["keyframes"] == 120
    assert row["submaps"] == 3
    assert row["ratio"] > 0
    assert max(part["variables"] for part in row["parts"]) < 150
    assert row["error"] < row["before"] + 0.3


def test_a_map_of_landmarks_is_measured_while_it_grows(tmp_path: Path) -> None:
    outcome = CliRunner().invoke(app, ["slam", "--landmarks", "60", "--json", str(tmp_path / "f.json")])
    assert outcome.exit_code == 0, outcome.output
    assert "last tenth to second one:" in outcome.stdout
    text = (tmp_path / "f.json").read_text()
    (row,) = json.loads(text)["rows"] if "rows" in json.loads(text) else json.loads(text)
    assert row["landmarks"] == row["parts"][-1]["landmarks"] == 60
    assert row["f1"] == 1.0
    assert max(part["local"] for part in row["parts"]) < 45


def test_scans_are_counted_and_timed() -> None:
    cost = bench_all_in("street", SimulatedScans(0, 6))
    assert (cost.scans, cost.submaps) == (6, 1)
    assert cost.points > 1000
    assert np.isfinite([cost.mean, cost.keyframe, cost.longest, cost.finish]).all()


def test_one_thing_is_asked_for_at_a_time() -> None:
    outcome = CliRunner().invoke(app, ["slam", "--drive", "120", "--dense", "3"])
    assert outcome.exit_code != 0
    assert "expected one of --dataroot, --drive, --landmarks and --dense" in outcome.output

"""`python -m benchmarks streaming` on a short recording: it counts what was put in, and compares with the whole."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from benchmarks.app import app
from benchmarks.streaming import StreamingBenchSettings, bench_streaming, write_traffic
from data_tools.datasets.detection_files import read_detections
from saga_fg.errors import InputError


def test_cars_come_in_platoons_and_are_hidden_at_times(tmp_path: Path) -> None:
    settings = StreamingBenchSettings(objects=20, seconds=60.0, seed=1)
    write_traffic(tmp_path / "table.csv", settings)
    dataset = read_detections(tmp_path / "table.csv")
    frames = dataset.scene(dataset.scenes[0]).frames
    assert len(frames) == settings.frames == 600
    assert 0.85 < sum(len(frame) for frame in frames) / (600 * 20) < 0.99  # the others are hidden
    roads = {round(y / 1000) for frame in frames for y in frame.detections.boxes.position[:, 1].tolist()}
    assert len(roads) > 4  # a new platoon takes another road


def test_memory_is_read_and_the_labels_are_those_of_the_whole(tmp_path: Path) -> None:
    arguments = "streaming --objects 5 --seconds 12 --rate 4 --compared 12 --json"
    done = CliRunner().invoke(app, [*arguments.split(), str(tmp_path / "figures.json")])
    assert done.exit_code == 0, done.output
    result = json.loads((tmp_path / "figures.json").read_text())["result"]
    assert result["boxes"] > 100
    assert result["largest_difference"] < 1e-3
    assert result["differing"] <= result["compared"] / 50
    assert result["rows"][-1]["recorded"] == 12.0
    assert result["at_once"] > 0.1
    assert result["peak"] == max(row["peak"] for row in result["rows"])
    assert result["growth"] == pytest.approx(result["peak"] / result["rows"][0]["peak"])


def test_settings_are_checked() -> None:
    with pytest.raises(InputError, match="objects"):
        bench_streaming(StreamingBenchSettings(objects=2))


def test_missed_detections_and_clutter_are_as_many_as_asked_for(tmp_path: Path) -> None:
    settings = StreamingBenchSettings(objects=20, seconds=20.0, seed=1, detected=0.5, clutter=7.0)
    write_traffic(tmp_path / "table.csv", settings)
    dataset = read_detections(tmp_path / "table.csv")
    frames = dataset.scene(dataset.scenes[0]).frames
    assert sum(map(len, frames)) / len(frames) == pytest.approx(0.5 * 0.94 * 20 + 7, rel=0.1)

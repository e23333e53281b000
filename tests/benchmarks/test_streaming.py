"""`python -m benchmarks streaming` on a short recording: it counts what was put in, and compares with the whole."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.streaming import write_traffic
from data_tools.datasets.detection_files import read_detections


def test_cars_come_in_platoons_and_are_hidden_at_times(tmp_path: Path) -> None:
    write_traffic(tmp_path / "table.csv", 20, 60.0, 1, 1.0, 0.0)
    dataset = read_detections(tmp_path / "table.csv")
    frames = dataset.scene(dataset.scenes[0]).frames
    assert len(frames) == 600
    assert 0.85 < sum(len(frame) for frame in frames) / (600 * 20) < 0.99  # the others are hidden
    roads = {round(y / 1000) for frame in frames for y in frame.detections.boxes.position[:, 1].tolist()}
    assert len(roads) > 4  # a new platoon takes another road


def test_memory_is_read_and_the_labels_are_those_of_the_whole(bench) -> None:
    *read, whole, short = bench("streaming --objects 5 --seconds 12 --compared 12")
    assert whole["boxes"] > 100
    assert short["off by at most, m"] < 1e-3
    assert short["boxes of one alone"] <= short["boxes"] / 50
    assert short["MB at once"] > 0.1
    assert read[-1]["read, s"] == 12.0
    assert whole["peak / first quarter's"] == pytest.approx(read[-1]["most so far, MB"] / read[0]["most so far, MB"])

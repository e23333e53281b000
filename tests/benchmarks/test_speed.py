"""The benchmark of speed: rows with ratios and growth, a profile that speedscope reads, and the frozen clock."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.app import app
from benchmarks.frozen_greedy import FrozenGreedy
from benchmarks.measuring import environment
from benchmarks.speed import FROZEN, METHODS, SpeedBenchSettings, bench_speed
from benchmarks.speed_scenes import speed_config, speed_frames
from saga_fg.kernels.compilation import only_numpy
from saga_fg.tracking import GreedySettings, GreedyTracker


@pytest.fixture(scope="module")
def result():
    return bench_speed(SpeedBenchSettings(sizes=(5, 100, 120), frames=4, round_trips=0))


def test_every_method_and_the_frozen_one_have_a_row_for_every_case(result) -> None:
    cases = [f"{size} {ties}" for ties in ("loose", "dense") for size in (5, 100, 120)]
    assert [(row.case, row.method) for row in result.rows] == [(c, m) for c in cases for m in (*METHODS, FROZEN)]
    for row in result.rows:
        reference = next(other for other in result.rows if other.case == row.case and other.method == "centerpoint")
        assert row.to_centerpoint == pytest.approx(row.median / reference.median)
        assert row.median <= row.p99
        assert row.memory > 0
        assert math.isfinite(row.to_filters * row.to_svd * row.to_frozen)


def test_growth_is_of_the_larger_cases(result) -> None:
    assert set(result.growth) == {f"{ties}, {m}" for ties in ("loose", "dense") for m in (*METHODS, FROZEN)}


def test_stages_are_those_of_the_counted_frames(result) -> None:
    for row in result.rows:
        assert bool(row.stages) == (row.method in ("saga", "kf"))
        assert sum(row.stages.values()) < 20 * row.p99


@pytest.mark.parametrize("ties", ["loose", "dense"])
def test_all_simulated_objects_are_tracked_and_tied_as_said(ties) -> None:
    tracker = speed_config(ties).new_tracker("saga")
    for frame in speed_frames(60, ties, 12, seed=1):
        tracks = tracker.step(frame)
    assert len(tracks.id) == 60
    assert sum(len(edges.target) for edges in tracker.graph.edges) >= (60 if ties == "dense" else 20)


def test_the_frozen_clock_matches_as_centerpoint_does() -> None:
    frozen, greedy = FrozenGreedy(), GreedyTracker(GreedySettings())
    for frame in speed_frames(40, "dense", 15, seed=2):
        boxes = frame.detections.boxes
        ids = frozen.step(frame.timestamp, boxes.label, boxes.position, frame.detections.score)
        np.testing.assert_array_equal(ids, greedy.step(frame).id)


def test_the_command_writes_figures_and_a_profile(tmp_path: Path) -> None:
    figures, profile = tmp_path / "figures.json", tmp_path / "profile.json"
    arguments = f"speed --sizes 20 --frames 10 --round-trips 2 --json {figures} --profile {profile}"
    outcome = CliRunner().invoke(app, arguments.split())
    assert outcome.exit_code == 0, outcome.output
    result = json.loads(figures.read_text())
    assert len(result["rows"]) == 8
    assert 0 < result["service"]["p50"] <= result["service"]["p99"]
    assert "live service" in outcome.output
    written = json.loads(profile.read_text())
    samples, frames = written["profiles"][0]["samples"], written["shared"]["frames"]
    assert len(samples) == len(written["profiles"][0]["weights"])
    assert all(0 <= k < len(frames) for stack in samples for k in stack)


def test_the_environment_says_whether_kernels_ran() -> None:
    assert environment()["kernels"] in ("compiled", "none")
    with only_numpy():
        assert environment()["kernels"] == "none"
    assert "numba" in environment()


def test_the_command_asks_for_numbers() -> None:
    result = CliRunner().invoke(app, ["speed", "--sizes", ""])
    assert result.exit_code == 2
    assert "--sizes: expected whole numbers >= 1" in result.output

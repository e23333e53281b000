"""The incremental smoother beside Levenberg-Marquardt on nonlinear scenes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.app import app
from benchmarks.sampled_traffic import providers
from benchmarks.settling import APART, EVADING, MIXED, NEAR, SILENT, STRAIGHT, largest_difference, sample_scene
from saga_fg.estimators import BatchSolver, IncrementalSmoother


@pytest.mark.parametrize("kind", [EVADING, STRAIGHT])
def test_two_who_cross_come_near_each_other(kind: str) -> None:
    scene = sample_scene(kind, np.random.default_rng(3), frames=10)
    apart = [np.hypot(*(one.states[0] - one.states[1])[:2]) for one in scene.frames]
    assert apart[0] == pytest.approx(APART, abs=0.1)
    assert min(apart) < NEAR


def test_the_smoother_is_compared_with_the_minimum_of_the_same_graph() -> None:
    scene = sample_scene(EVADING, np.random.default_rng(4), frames=8)
    smoother, batch = IncrementalSmoother(providers(scene), None), BatchSolver(providers(scene))
    for frame in scene.frames:
        smoother.step(frame.time)
        batch.step(frame.time)
    assert smoother.graph().variables.keys() == batch.graph().variables.keys()
    assert largest_difference(smoother, batch) < SILENT
    smoother.step(99.0, [])
    assert largest_difference(smoother, batch) < SILENT


def test_the_command_prints_a_row_for_every_kind(tmp_path: Path) -> None:
    figures = tmp_path / "figures.json"
    result = CliRunner().invoke(app, f"settling --mixed 1 --crossings 2 --frames 8 --json {figures}".split())
    assert result.exit_code == 0, result.output
    rows = json.loads(figures.read_text())["rows"]
    assert [row["scenes"] for row in rows] == [MIXED, EVADING, STRAIGHT]
    assert all(row["frames"] == 8 and 0 <= row["settled, %"] <= 100 for row in rows)

"""Moments matched node by node, beside every sequence of modes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.app import app
from benchmarks.modes import FRAMES, draw, enumerated, matched


def test_both_are_exact_where_one_node_has_been_measured_once() -> None:
    frames = draw(np.random.default_rng(1), 1)
    exact, own = enumerated(frames), matched(frames)
    np.testing.assert_allclose(own[0].mean, exact[0].mean, atol=1e-9)
    np.testing.assert_allclose(own[0].sigma, exact[0].sigma, rtol=1e-9)
    np.testing.assert_allclose(own[0].stands, exact[0].stands, atol=1e-9)
    assert np.abs(own[-1].mean - exact[-1].mean).max() > 1e-6


def test_enumeration_finds_who_stands() -> None:
    certain = []
    for seed in range(20):
        frames = draw(np.random.default_rng(seed), 2)
        speed = np.linalg.norm(frames[-1].states[:, 2:], axis=1)
        certain += zip(speed, enumerated(frames)[-1].stands, strict=True)
    stands = np.array([p for speed, p in certain if speed < 0.3])
    drives = np.array([p for speed, p in certain if speed > 2])
    assert stands.mean() > drives.mean() + 0.3


def test_the_command_prints_a_row_for_every_number_of_nodes(tmp_path: Path) -> None:
    figures = tmp_path / "figures.json"
    result = CliRunner().invoke(app, f"modes --scenes 2 --json {figures}".split())
    assert result.exit_code == 0, result.output
    rows = json.loads(figures.read_text())["rows"]
    assert [(row["nodes"], row["frames"]) for row in rows] == list(FRAMES.items())
    assert all(0 < row["means, sigma"] < 1 and row["sequences"] <= 4096 for row in rows)
    assert [row["matched / enumerated"] for row in rows] == pytest.approx([1, 1, 1], abs=0.2)

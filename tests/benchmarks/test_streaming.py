"""`bench streaming` on a short recording: what it counts is what was put in."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from benchmarks.app import app
from benchmarks.streaming import StreamingBenchSettings, bench_streaming, traffic
from saga_fg.errors import InputError


def test_objects_come_and_go_in_platoons() -> None:
    settings = StreamingBenchSettings(objects=20, seed=1)
    present: set[int] = set()
    born = gone = seen = 0
    for instant in traffic(settings, 600):
        present -= set(instant.gone.tolist())
        present |= set(instant.born.tolist())
        assert set(instant.transition.nodes.tolist()) == present
        assert len(present) == len(instant.truth) == 20
        born, gone, seen = born + len(instant.born), gone + len(instant.gone), seen + len(instant.measurements)
    assert born == gone + 20
    assert gone % 5 == 0
    assert 5 <= gone <= 60
    assert 0.85 < seen / (600 * 20) < 0.99  # the others are hidden


def test_every_moment_is_smoothed_once_and_as_the_batch_smoother_does(tmp_path: Path) -> None:
    result = CliRunner().invoke(
        app, ["streaming", "--objects", "10", "--seconds", "40", "--json", str(tmp_path / "figures.json")]
    )
    assert result.exit_code == 0, result.output
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert figures["moments"] == 400
    assert len(figures["rows"]) == 10
    assert all(0 < row["held"] < 250 for row in figures["rows"])
    assert figures["largest_difference"] < 1e-3
    assert 0.8 < figures["anees"] < 1.25
    assert "400 moments; peak memory" in result.stdout


def test_settings_are_checked() -> None:
    with pytest.raises(InputError, match="objects"):
        bench_streaming(StreamingBenchSettings(objects=2))

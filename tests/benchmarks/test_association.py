"""The benchmark of matching runs, and its ratios are those of its times."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from benchmarks.app import app


def test_a_row_for_every_method_and_size(tmp_path: Path) -> None:
    figures = tmp_path / "figures.json"
    arguments = ["association", "--objects", "10,20", "--seconds", "2", "--json", str(figures)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    rows = json.loads(figures.read_text())["rows"]
    assert [(row["objects"], row["method"]) for row in rows] == [
        (n, method) for n in (10, 20) for method in ("hungarian", "greedy", "graph")
    ]
    for row, baseline in zip(rows, (0, 0, 0, 3, 3, 3), strict=True):
        assert row["ratio"] == pytest.approx(row["milliseconds"] / rows[baseline]["milliseconds"])
        assert row["whole_milliseconds"] > row["milliseconds"] > 0


@pytest.mark.parametrize("objects", ["many", "0", "-3", "5,2.5", "\u00b2", "9" * 5000])
@pytest.mark.parametrize("command", ["association", "scaling"])
def test_a_number_that_is_none_is_refused(command: str, objects: str) -> None:
    result = CliRunner().invoke(app, [command, f"--objects={objects}"])
    assert result.exit_code == 2
    assert "--objects: expected whole numbers >= " in result.output

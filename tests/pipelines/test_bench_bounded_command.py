"""`saga-fg bench bounded` runs from end to end."""

from __future__ import annotations

from typer.testing import CliRunner

from pipelines.cli import app


def test_it_prints_a_row_for_each_bound() -> None:
    result = CliRunner().invoke(app, ["bench", "bounded", "--nodes", "40", "--frames", "2"])
    assert result.exit_code == 0, result.output
    rows = [line.split()[1] for line in result.output.splitlines() if line.startswith("│")]
    assert rows == ["1", "2", "3"]

"""`saga-fg bench coasting` on simulated traffic."""

import numpy as np
from typer.testing import CliRunner

from pipelines.bench.coasting_trajectories import CoastingErrors, coasting_figures
from pipelines.cli.main import app


def test_figures_are_those_of_the_errors_at_the_end_of_each_gap():
    kf = np.tile([1.0, 2.0, 4.0, np.nan, np.nan, np.nan], (40, 1))
    kf[:, 5] = 8.0
    errors = CoastingErrors(
        np.zeros(40, dtype=np.int64),
        np.arange(40) // 4,
        np.full(40, "car"),
        0.5 * np.arange(1, 7),
        {"kf": kf, "learned": 0.5 * kf},
    )
    rows = {(row.gap, row.method): row for row in coasting_figures(errors)}
    assert set(rows) == {(gap, method) for gap in (1.0, 3.0) for method in ("kf", "learned")}
    assert rows[1.0, "kf"].median == 2.0
    assert rows[3.0, "learned"].mean == 4.0
    assert rows[3.0, "learned"].mean_change.estimate == -0.5
    assert rows[1.0, "kf"].mean_change is None


def test_the_command_writes_its_figures(tmp_path):
    out = tmp_path / "coasting.json"
    result = CliRunner().invoke(app, ["bench", "coasting", "--data", "file=x.csv"])
    assert result.exit_code == 2
    assert "expected recordings with truth" in result.output
    result = CliRunner().invoke(app, ["bench", "coasting", "--data", "simulated=1", "--json", str(out)])
    assert result.exit_code == 2
    assert "at least two recordings" in result.output
    assert not out.exists()

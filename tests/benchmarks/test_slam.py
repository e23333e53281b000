"""LiDAR odometry beside KISS-ICP."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.app import app
from benchmarks.slam import bench_slam
from data_tools.datasets.kitti import KittiScans
from data_tools.simulator.street import SimulatedScans


def test_the_benchmark_measures_both_on_the_same_scans() -> None:
    pytest.importorskip("kiss_icp", reason="kiss-icp comes with the extra bench")
    rows = bench_slam(SimulatedScans(2, 20))
    assert [(row.case, row.contender) for row in rows] == [
        (case, name) for case in ("as recorded", "de-skewed") for name in ("saga-fg", "kiss-icp")
    ]
    for row in rows:
        assert row.errors.poses == 20
        assert np.isfinite(row.errors.relative_translation)
        assert 0 < row.residual < 0.1
        assert row.milliseconds > 0
    assert all(
        row.errors.relative_translation < 0.05 for row in rows if row.contender == "saga-fg" and row.case == "de-skewed"
    )


def test_bench_slam_prints_and_writes_the_figures(recordings: Path, tmp_path: Path) -> None:
    kitti = recordings / "kitti"
    assert len(KittiScans(kitti, "0000")) == 90
    result = CliRunner().invoke(
        app,
        ["slam", "--dataroot", str(kitti), "--scans", "30", "--no-kiss", "--json", str(tmp_path / "f.json")],
    )
    assert result.exit_code == 0, result.output
    assert "as recorded" in result.stdout
    assert "de-skewed" in result.stdout
    assert (tmp_path / "f.json").read_text().count('"contender": "saga-fg"') == 2

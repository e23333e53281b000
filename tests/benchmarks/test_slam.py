"""`python -m benchmarks slam`: odometry beside KISS-ICP, cost of scans all in, and of landmarks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.scans import SimulatedScans
from benchmarks.slam import all_in_rows, odometry_rows
from data_tools.datasets.kitti import KittiScans


def test_both_are_measured_on_the_same_scans() -> None:
    pytest.importorskip("kiss_icp", reason="kiss-icp comes with the extra bench")
    rows = [row for _, row in odometry_rows(SimulatedScans(2, 20))]
    assert [(row["scans"], row["method"]) for row in rows] == [
        (case, name) for case in ("as recorded", "de-skewed") for name in ("saga-fg", "kiss-icp")
    ]
    for row in rows:
        assert np.isfinite(row["RPE, m per 10 m"])
        assert 0 < row["residual, mm"] < 100
        assert row["ms a scan"] > 0
    assert rows[2]["RPE, m per 10 m"] < 0.05


def test_the_command_on_recorded_scans(bench, recordings: Path) -> None:
    kitti = recordings / "kitti"
    assert len(KittiScans(kitti, "0000")) == 90
    rows = bench("slam --scans 20 --no-kiss", "--dataroot", str(kitti))
    assert [row["scans"] for row in rows if row.get("method") == "saga-fg"] == ["as recorded", "de-skewed"]
    assert any(row["table"] == "SLAM all in, CPU time" for row in rows)


def test_scans_are_counted_and_timed() -> None:
    (_, cost), *_ = all_in_rows(SimulatedScans(0, 6))
    assert (cost["scans"], cost["submaps"]) == (6, 1)
    assert cost["points a scan"] > 1000
    assert np.isfinite([cost["ms a scan"], cost["keyframe"], cost["longest"], cost["at the end, s"]]).all()


def test_a_map_of_landmarks_is_measured_while_it_grows(bench) -> None:
    *parts, whole = bench("slam --landmarks 60")
    assert whole["landmarks"] == parts[-1]["landmarks of the map"] == 60
    assert whole["F1 over pairs"] == 1.0
    assert max(part["in the local Gaussian"] for part in parts) < 45


def test_one_thing_is_asked_for_at_a_time(refused) -> None:
    assert "expected one of --dataroot, --landmarks and --dense" in refused("slam --landmarks 120 --dense 3")

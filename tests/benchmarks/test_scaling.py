"""Node-only filtering beside filters with edge states: the full one agrees exactly, and the command draws a picture."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.app import app
from benchmarks.flocks import flock
from benchmarks.graph_tracking import JointGraphTracking, SeparateGraphTracking
from benchmarks.scaling import APART, JOINT, NODES, SEPARATE, ScalingSettings, bench_scaling


@pytest.fixture(scope="module")
def rows():
    return {(row.nodes, row.contender): row for row in bench_scaling(ScalingSettings((4, 6), 4, frames=60))}


def test_with_all_correlations_edges_say_nothing_that_nodes_do_not(rows) -> None:
    """The node-only filter keeps the accuracy: the paper's claim, to the last digits."""
    assert rows[4, JOINT].largest_difference < 1e-9
    assert rows[4, JOINT].hidden_rmse == pytest.approx(rows[4, NODES].hidden_rmse, abs=1e-12)
    assert rows[4, JOINT].states == 4 * rows[4, NODES].states


def test_the_full_filter_is_left_out_beyond_its_limit(rows) -> None:
    assert (6, JOINT) not in rows
    assert {name for n, name in rows if n == 6} == {NODES, SEPARATE, APART}


def test_times_are_compared_with_the_node_only_filter(rows) -> None:
    for (n, _), row in rows.items():
        assert row.ratio == pytest.approx(row.milliseconds / rows[n, NODES].milliseconds)


def test_edges_of_their_own_are_right_where_nothing_couples_the_nodes() -> None:
    """Without interactions the nodes are independent, and both filters are the classical one."""
    drawn = flock("connected", 3, 15, 0, mixing=0.0)
    together, apart = JointGraphTracking(drawn), SeparateGraphTracking(drawn)
    for frame in drawn.frames:
        for each in (together, apart):
            each.prepare(frame)
            each.step()
    for a, b in zip(together.read(), apart.read(), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)


def test_the_command_writes_figures_and_a_picture(tmp_path: Path) -> None:
    figures, picture = tmp_path / "figures.json", tmp_path / "scaling.png"
    arguments = f"scaling --objects 3,4 --frames 30 --json {figures} --output {picture}"
    result = CliRunner().invoke(app, arguments.split())
    assert result.exit_code == 0, result.output
    assert len(json.loads(figures.read_text())["rows"]) == 8
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_frames_in_which_nobody_is_seen_are_predictions() -> None:
    """One of two objects is hidden, the other is missed now and then."""
    rows = {row.contender: row for row in bench_scaling(ScalingSettings((2,), 2, frames=60))}
    assert rows[JOINT].largest_difference < 1e-9
    assert all(np.isfinite(row.rmse) for row in rows.values())


def test_one_object_has_no_neighbours() -> None:
    result = CliRunner().invoke(app, ["scaling", "--objects", "1,5"])
    assert result.exit_code != 0
    assert "--objects: expected whole numbers >= 2" in result.output

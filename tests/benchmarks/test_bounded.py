"""The comparison of the bounded filter with the exact one, on a small flock."""

import math
from dataclasses import astuple

import pytest
from typer.testing import CliRunner

from benchmarks.app import app
from benchmarks.bounded import BoundedBenchSettings, bench_bounded
from saga_fg import InputError


def test_a_row_for_each_bound_and_farther_bounds_are_nearer_to_the_exact_filter():
    near, far, all_of_it = bench_bounded(BoundedBenchSettings(nodes=60, frames=3, warm_up=2, hops=(1, 3, 60)))
    assert [row.hops for row in (near, far, all_of_it)] == [1, 3, 60]
    assert all(math.isfinite(value) for row in (near, far) for value in astuple(row))
    assert near.mean_error > 3 * far.mean_error > 0
    assert near.nodes_per_cluster < far.nodes_per_cluster < all_of_it.nodes_per_cluster == 60
    assert all_of_it.worst_error < 1e-9
    assert all_of_it.anees_ratio == pytest.approx(1.0, abs=1e-9)


def test_settings_are_checked():
    with pytest.raises(InputError, match="nodes"):
        BoundedBenchSettings(nodes=3)
    with pytest.raises(InputError, match="mixing"):
        BoundedBenchSettings(mixing=1.0)


def test_the_command_prints_a_row_for_each_bound():
    result = CliRunner().invoke(app, ["bounded", "--nodes", "40", "--frames", "2"])
    assert result.exit_code == 0, result.output
    rows = [line.split()[1] for line in result.output.splitlines() if line.startswith("│")]
    assert rows == ["1", "2", "3"]

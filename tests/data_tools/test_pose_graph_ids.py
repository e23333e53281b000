"""Ids of poses as GTSAM's symbols are, near 2^63: read, solved and written exactly."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np
import pytest
from typer.testing import CliRunner

from data_tools.files.readers import TextTable
from data_tools.pose_graphs import city, read_g2o, write_g2o
from pipelines.cli import app
from saga_fg import InputError
from saga_fg.slam.pose_graph import PoseGraph, optimise_poses

_BUT_IDS = ("world_T_pose", "first", "second", "first_T_second", "information")


def of_two_robots() -> PoseGraph:
    """A city whose first half robot a drives, whose second half robot b."""
    graph, _ = city(60, seed=0)
    ids = [gtsam.symbol("a", row) if row < 30 else gtsam.symbol("b", row - 30) for row in range(60)]
    return PoseGraph(np.array(ids), *(getattr(graph, name) for name in _BUT_IDS))


def test_symbols_are_read_solved_and_written(tmp_path: Path) -> None:
    graph, path = of_two_robots(), tmp_path / "robots.g2o"
    write_g2o(path, graph)
    read = read_g2o(path)
    assert read.ids.tolist() == graph.ids.tolist()
    np.testing.assert_array_equal(read.first, graph.first)
    last = gtsam.symbol("b", 29)
    arguments = ["slam", "g2o", path, "--output", tmp_path / "out", "--certify", "--covariances", last]
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    assert read_g2o(tmp_path / "out" / "poses.g2o").ids.tolist() == graph.ids.tolist()
    rows = (tmp_path / "out" / "covariances.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows[1:]] == [str(last)]


def test_a_prior_on_the_largest_id_is_solved(tmp_path: Path) -> None:
    path, last = tmp_path / "prior.g2o", 2**63 - 1
    path.write_text(
        f"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 {last} 1 0 0\nEDGE_SE2 0 {last} 1 0 0 1 0 0 1 0 1\n"
        f"EDGE_PRIOR_SE2 {last} 5 0 0 1 0 0 1 0 1\n"
    )
    optimised = optimise_poses(read_g2o(path), certify=True)
    assert optimised.chordal is not None
    for poses in (optimised.world_T_pose, optimised.chordal.world_T_pose):
        np.testing.assert_allclose(poses[:, 0, 2], [4, 5], atol=1e-6)


def test_ids_beyond_are_located(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    for wrong in ("9223372036854775808", "7e18", "1.5", "-1"):
        path.write_text(f"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 {wrong} 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
        with pytest.raises(InputError, match="line 2: id: expected a whole number from 0 to 9223372036854775807, got"):
            read_g2o(path)


def test_whole_numbers_may_be_written_as_others() -> None:
    table = TextTable.from_rows(Path("table"), [["12"], ["12.0"], ["1.2e1"], ["9223372036854775807"]], [1, 2, 3, 4])
    assert table.integers(0, "id", 0, 2**63 - 1).tolist() == [12, 12, 12, 2**63 - 1]

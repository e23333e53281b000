"""The graph of a run as files: all its measurements count when it is read, and what is none is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.slam.saved_graph import read_graph
from saga_fg.errors import InputError


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("0,0,tower,1 2 3,1 0 1", "line 2: kind: expected one of wall, pole, road line, ground, got 'tower'"),
        ("7,0,pole,1 2 3,1 0 1", "line 2: expected numbers of a keyframe of graph.g2o"),
        ("0,0,pole,1 2 3,1 0", "line 2: expected the numbers of an observation of a pole"),
        ("0,0,pole", "line 2: expected 5 columns, got 3"),
    ],
)
def test_a_graph_that_is_none_is_named(tmp_path: Path, row: str, message: str) -> None:
    poses = "".join(f"VERTEX_SE3:QUAT {x} {x} 0 0 0 0 0 1\n" for x in range(2))
    information = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
    (tmp_path / "graph.g2o").write_text(f"{poses}EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {information}\n")
    (tmp_path / "observations.csv").write_text(f"keyframe,landmark,kind,value,covariance\n{row}\n")
    with pytest.raises(InputError, match=message):
        read_graph(tmp_path)


@pytest.mark.parametrize("backwards", [False, True])
def test_all_measurements_of_a_read_graph_count(tmp_path: Path, backwards: bool) -> None:
    eye = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
    pair = "EDGE_SE3:QUAT 1 0 -1 0 0 0 0 0 1" if backwards else "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1"
    lines = [f"{pair} {eye}", f"EDGE_SE3:QUAT 0 1 2 0 0 0 0 0 1 {eye}", f"EDGE_SE3:QUAT 1 2 1 0 0 0 0 0 1 {eye}"]
    (tmp_path / "graph.g2o").write_text("".join(f"{line}\n" for line in lines))
    (tmp_path / "observations.csv").write_text("keyframe,landmark,kind,value,covariance\n")
    poses = read_graph(tmp_path).solved().world_T_pose
    np.testing.assert_allclose(poses[:, 0, 3], [0.0, 1.5, 2.5], atol=1e-6)


def test_a_read_graph_is_in_space(tmp_path: Path) -> None:
    (tmp_path / "graph.g2o").write_text("EDGE_SE2 0 1 1 0 0 100 0 0 100 0 1000\n")
    (tmp_path / "observations.csv").write_text("keyframe,landmark,kind,value,covariance\n")
    with pytest.raises(InputError, match="expected poses in space, got poses in the plane"):
        read_graph(tmp_path)

"""The g2o format: what is read is what was written, GTSAM reads the same, and what is wrong is located."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np
import pytest

from data_tools.pose_graphs import read_g2o, write_g2o
from saga_fg import InputError
from saga_fg.slam.pose_graph import factor_graph, pose_values

PLANAR = """\
VERTEX_SE2 7 1 0 1.5707963267948966
VERTEX_SE2 3 0 0 0

# a comment
FIX 3
EDGE_SE2 3 7 1.5 0.25 1.5 4 1 0.5 5 0.25 6
"""
SPATIAL = """\
VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 1 1 2 3 0 0 0.6 0.8
EDGE_SE3:QUAT 0 1 1.25 2 3 0.6 0 0 0.8 11 1 0 0 0 0 12 0 0 0 0 13 0 0 2 14 0 0 15 0 16
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "graph.g2o"
    path.write_text(text)
    return path


def test_poses_in_the_plane_are_read_in_the_order_of_their_ids(tmp_path: Path) -> None:
    graph = read_g2o(written(tmp_path, PLANAR))
    assert graph.dim == 2
    assert graph.ids.tolist() == [3, 7]
    assert (graph.first.tolist(), graph.second.tolist()) == ([0], [1])
    np.testing.assert_allclose(graph.world_T_pose[1], [[0, -1, 1], [1, 0, 0], [0, 0, 1]], atol=1e-15)
    np.testing.assert_array_equal(graph.first_T_second[0, :2, 2], [1.5, 0.25])
    np.testing.assert_array_equal(graph.information[0], [[4, 1, 0.5], [1, 5, 0.25], [0.5, 0.25, 6]])


def test_information_in_space_is_reordered_to_rotation_first(tmp_path: Path) -> None:
    graph = read_g2o(written(tmp_path, SPATIAL))
    assert graph.dim == 3
    np.testing.assert_array_equal(np.diag(graph.information[0]), [14, 15, 16, 11, 12, 13])
    assert graph.information[0, 2, 5] == 2.0  # z with the turn about z
    assert graph.information[0, 3, 4] == 1.0  # x with y
    np.testing.assert_allclose(graph.world_T_pose[1, :3, 0], [0.28, 0.96, 0], atol=1e-15)


@pytest.mark.parametrize(("text", "spatial"), [(PLANAR, False), (SPATIAL, True)])
def test_gtsam_reads_the_same(tmp_path: Path, text: str, spatial: bool) -> None:
    path = written(tmp_path, "\n".join(line for line in text.splitlines() if not line.startswith(("#", "FIX"))) + "\n")
    theirs, values = gtsam.readG2o(str(path), spatial)
    graph = read_g2o(path)
    ours = factor_graph(graph).error(pose_values(graph.world_T_pose))
    assert ours == pytest.approx(gtsam.NonlinearFactorGraph(theirs).error(values), rel=1e-9)


@pytest.mark.parametrize("text", [PLANAR, SPATIAL])
def test_writing_and_reading_gives_the_same_graph(tmp_path: Path, text: str) -> None:
    graph = read_g2o(written(tmp_path, text))
    write_g2o(tmp_path / "again.g2o", graph)
    again = read_g2o(tmp_path / "again.g2o")
    for name in ("ids", "first", "second", "world_T_pose", "first_T_second", "information"):
        np.testing.assert_allclose(getattr(again, name), getattr(graph, name), rtol=1e-14, atol=1e-15)


def test_what_is_wrong_is_located(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for text, old, new, message in [
        (PLANAR, "VERTEX_SE2 3", "VERTEX_XYZ 3", "line 2: unknown record 'VERTEX_XYZ'; did you mean .* be removed"),
        (PLANAR, "3 0 0 0", "3 0 0", "line 2: expected 4 values after VERTEX_SE2, got 3"),
        (PLANAR, "3 0 0 0", "3 0 nan 0", "line 2: y: expected a finite number, got 'nan'"),
        (PLANAR, "3 0 0 0", "3 0 0 east", "line 2: heading: expected a finite number, got 'east'"),
        (PLANAR, "3 0 0 0", "3 0 1e300 0", r"line 2: y: expected a number within 1e\+09, got 1e\+300"),
        (SPATIAL, "0 0 0.6 0.8", "0 0 0.6 1e300", r"line 2: qw: expected a number within 1e\+15, got 1e\+300"),
        (PLANAR, "4 1 0.5 5", "1e300 1 0.5 1e300", r"line 6: I11: expected a number within 1e\+15, got 1e\+300"),
        (PLANAR, "VERTEX_SE2 3", "VERTEX_SE2 7", "line 2: id: 7 is given twice"),
        (PLANAR, "VERTEX_SE2 3", "VERTEX_SE2 3.5", "line 2: id: expected a whole number"),
        (PLANAR, "FIX 3", "FIX it", "line 5: expected ids of poses after FIX, got 'it'"),
        (PLANAR, "EDGE_SE2 3 7", "EDGE_SE2 3 8", "line 6: second: there is no pose 8"),
        (PLANAR, "EDGE_SE2 3 7", "EDGE_SE2 7 7", "line 6: second: expected another pose"),
        (PLANAR, "4 1 0.5 5", "4 9 0.5 5", r"line 6: I11 ... I33: expected a positive definite matrix"),
        (PLANAR, PLANAR, "", "expected poses and edges"),
        (PLANAR, PLANAR, PLANAR.splitlines()[0], "expected EDGE_SE2 records"),
        (PLANAR, PLANAR, PLANAR + SPATIAL, "all in the plane .* or all in space"),
        (SPATIAL, "0 0 0.6 0.8", "0 0 0.6 0.9", "line 2: qx qy qz qw: expected a unit quaternion"),
    ]:  # fmt: skip
        with subtests.test(message):
            path = written(tmp_path, text.replace(old, new, 1))
            with pytest.raises(InputError, match=message) as caught:
                read_g2o(path)
            assert str(path) in str(caught.value)


def test_a_file_of_measurements_alone_starts_at_dead_reckoning(tmp_path: Path) -> None:
    """Pose 9 is reached against the direction of its measurement, pose 4 by the shorter way."""
    graph = read_g2o(
        written(
            tmp_path,
            "EDGE_SE2 2 4 1 0 1.5707963267948966 1 0 0 1 0 1\n"
            "EDGE_SE2 9 4 0 2 0 1 0 0 1 0 1\n"
            "EDGE_SE2 9 2 5 5 1 1 0 0 1 0 1\n",
        )
    )
    assert graph.ids.tolist() == [2, 4, 9]
    np.testing.assert_array_equal(graph.world_T_pose[0], np.eye(3))
    np.testing.assert_allclose(graph.world_T_pose[1], [[0, -1, 1], [1, 0, 0], [0, 0, 1]], atol=1e-15)
    np.testing.assert_allclose(graph.world_T_pose[2], np.linalg.inv(graph.first_T_second[2]), atol=1e-12)


def test_slightly_indefinite_information_is_projected_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    graph = read_g2o(written(tmp_path, PLANAR.replace("4 1 0.5 5 0.25 6", "4 2.00001 0 1 0 6")))
    values = np.linalg.eigvalsh(graph.information[0])
    assert 0 < values[0] < 1e-8
    np.testing.assert_allclose(graph.information[0], [[4, 2, 0], [2, 1, 0], [0, 0, 6]], atol=1e-4)
    assert "line 6: smallest eigenvalue -8" in caplog.text
    assert "1 information matrices" in caplog.text


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.g2o: cannot be read"):
        read_g2o(tmp_path / "none.g2o")


@pytest.mark.parametrize(("fixed", "warned"), [("FIX 3", False), ("FIX 7", True), ("FIX 3 7", True)])
def test_poses_that_are_not_held_as_the_file_says_are_warned_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, fixed: str, warned: bool
) -> None:
    read_g2o(written(tmp_path, PLANAR.replace("FIX 3", fixed)))
    assert ("FIX 7 has no effect, as pose 3, the first, is held" in caplog.text) == warned


@pytest.mark.parametrize(
    ("text", "places"),
    [
        (PLANAR, "EDGE_PRIOR_SE2_XY 3 1 2 4 1 9\nEDGE_PRIOR_SE2_XY 7 2.5 2.25 4 0 4\n"),
        (SPATIAL, "EDGE_SE3_XYZ_PRIOR 1 0 1 2 3 4 0 1 5 0 6\n"),
    ],
)
def test_known_places_are_read_and_written(tmp_path: Path, text: str, places: str) -> None:
    graph = read_g2o(written(tmp_path, text + places))
    assert graph.places is not None
    assert graph.priors is None
    assert graph.anchored
    if graph.dim == 2:
        np.testing.assert_array_equal(graph.ids[graph.places.pose], [3, 7])
        np.testing.assert_array_equal(graph.places.position, [[1, 2], [2.5, 2.25]])
        np.testing.assert_array_equal(graph.places.information[0], [[4, 1], [1, 9]])
    else:
        np.testing.assert_array_equal(graph.places.information[0], [[4, 0, 1], [0, 5, 0], [1, 0, 6]])
    again = tmp_path / "again.g2o"
    write_g2o(again, graph)
    copy = read_g2o(again).places
    assert copy is not None
    np.testing.assert_array_equal(copy.position, graph.places.position)
    np.testing.assert_array_equal(copy.information, graph.places.information)


def test_a_known_place_of_no_pose_is_located(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="line 7: pose: there is no pose 5"):
        read_g2o(written(tmp_path, PLANAR + "EDGE_PRIOR_SE2_XY 5 1 2 4 1 9\n"))

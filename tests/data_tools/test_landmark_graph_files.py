"""Landmarks and priors of g2o files: read, optimised, written; what is wrong is located."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_tools.pose_graphs import read_g2o, write_g2o
from saga_fg import InputError
from saga_fg.slam.pose_graph import optimise_poses

PLANAR = """\
VERTEX_SE2 1 5.1 2.9 0.4
VERTEX_SE2 2 6.9 3.1 0.6
VERTEX_SE2 3 6.9 5.1 2.0
VERTEX_XY 10 8 8
VERTEX_XY 11 4 7
EDGE_SE2 1 2 1.7551651237807455 -0.958851077208406 0.0 100 0 0 100 0 400
EDGE_SE2 2 3 0.958851077208406 1.7551651237807455 1.5 100 0 0 100 0 400
EDGE_SE2_PRIOR 2 7 3 0.5 100 0 0 100 0 400
EDGE_SE2_XY 1 10 5.029875378692133 2.9496361936392548 25 0 25
EDGE_BEARING_SE2_XY 1 11 1.3157749899217608 900
EDGE_BEARING_SE2_XY 2 11 1.7142974355881808 900
BR 3 10 -0.7509542276017456 3.1622776601683795 0.02 0.1
"""
SPATIAL = """\
PARAMS_SE3OFFSET 4 0 0 0.5 0 0 0.7071067811865476 0.7071067811865476
VERTEX_SE3:QUAT 1 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 2 2.1 0.1 0 0 0 0 1
VERTEX_TRACKXYZ 9 3.2 4 1
EDGE_SE3:QUAT 1 2 2 0 0 0 0 0 1 100 0 0 0 0 0 100 0 0 0 0 100 0 0 0 400 0 0 400 0 400
EDGE_SE3_TRACKXYZ 1 9 4 4 -3 0.5 1 0 0 4 0 9
EDGE_SE3_TRACKXYZ 2 9 4 4 -1 0.5 1 0 0 4 0 9
EDGE_SE3_PRIOR 1 4 5 0 0.5 0 0 0.7071067811865476 0.7071067811865476 100 0 0 0 0 0 50 0 0 0 0 100 0 0 0 400 0 0 400 0 400
"""  # noqa: E501


def written(folder: Path, text: str) -> Path:
    path = folder / "graph.g2o"
    path.write_text(text)
    return path


def test_all_planar_records_agree_on_one_world(tmp_path: Path) -> None:
    """The measurements are those of the poses (5.0, 3.0, 0.5) ..., so the optimum has no error."""
    graph = read_g2o(written(tmp_path, PLANAR))
    assert graph.landmarks is not None
    assert [seen.kind for seen in graph.landmarks.observations] == ["point", "bearing", "range bearing"]
    assert graph.landmarks.position.tolist() == [[8, 8], [4, 7]]
    optimised = optimise_poses(graph)
    assert optimised.error < 1e-9
    np.testing.assert_allclose(optimised.world_T_pose[:, :2, 2], [[5, 3], [7, 3], [7, 5]], atol=1e-6)
    assert optimised.landmarks is not None
    np.testing.assert_allclose(optimised.landmarks, [[8, 8], [4, 7]], atol=1e-6)
    assert optimised.covariances().shape == (3, 3, 3)
    assert max(optimised.errors.values()) < 1e-9


@pytest.mark.parametrize("text", [PLANAR, SPATIAL])
def test_writing_and_reading_gives_the_same_graph(tmp_path: Path, text: str) -> None:
    graph = read_g2o(written(tmp_path, text))
    write_g2o(tmp_path / "again.g2o", graph)
    again = read_g2o(tmp_path / "again.g2o")
    assert graph.landmarks is not None
    assert again.landmarks is not None
    assert graph.priors is not None
    assert again.priors is not None
    for one, other in zip(graph.landmarks.observations, again.landmarks.observations, strict=True):
        for name in ("pose", "landmark", "z", "information"):
            np.testing.assert_allclose(getattr(other, name), getattr(one, name), rtol=1e-12, atol=1e-12)
    for name in ("pose", "world_T_pose", "information"):
        np.testing.assert_allclose(getattr(again.priors, name), getattr(graph.priors, name), rtol=1e-12, atol=1e-12)


def test_offsets_of_sensors_are_taken_into_the_measurements(tmp_path: Path) -> None:
    """A sensor half a metre up, turned to the left, sees the landmark (3, 4, 1) at (4, -3, 0.5)."""
    graph = read_g2o(written(tmp_path, SPATIAL))
    assert graph.landmarks is not None
    assert graph.priors is not None
    np.testing.assert_allclose(graph.landmarks.observations[0].z, [[3, 4, 1], [1, 4, 1]], atol=1e-12)
    np.testing.assert_allclose(np.diag(graph.landmarks.observations[0].information[0]), [4, 1, 9], atol=1e-12)
    np.testing.assert_allclose(graph.priors.world_T_pose[0, :3, 3], [5, 0, 0], atol=1e-12)
    np.testing.assert_allclose(np.diag(graph.priors.information[0])[3:], [50, 100, 100], atol=1e-9)
    optimised = optimise_poses(graph)
    assert optimised.error < 1e-9
    np.testing.assert_allclose(optimised.world_T_pose[:, :3, 3], [[5, 0, 0], [7, 0, 0]], atol=1e-6)
    assert optimised.landmarks is not None
    np.testing.assert_allclose(optimised.landmarks, [[8, 4, 1]], atol=1e-6)


def test_without_vertices_landmarks_start_where_they_are_seen(tmp_path: Path) -> None:
    edges = "\n".join(line for line in PLANAR.splitlines() if not line.startswith("VERTEX")) + "\n"
    graph = read_g2o(written(tmp_path, edges))
    assert graph.landmarks is not None
    assert np.isfinite(graph.landmarks.position).all()
    found = optimise_poses(graph)
    whole = optimise_poses(read_g2o(written(tmp_path, PLANAR)))
    assert found.error < 1e-9
    assert found.landmarks is not None
    assert whole.landmarks is not None
    np.testing.assert_allclose(found.landmarks, whole.landmarks, atol=1e-3)


def test_what_is_wrong_is_located(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for text, old, new, message in [
        (PLANAR, "EDGE_SE2_XY 1 10", "EDGE_SE2_XY 1 12", "line 9: landmark: there is no landmark 12"),
        (PLANAR, "EDGE_SE2_XY 1 10", "EDGE_SE2_XY 4 10", "line 9: pose: there is no pose 4"),
        (PLANAR, "VERTEX_XY 10", "VERTEX_XY 11", "line 5: id: 11 is given twice"),
        (PLANAR, "0.02 0.1", "0.02 0", "line 12: expected standard deviations of at least 1e-07, got 0"),
        (PLANAR, "0.02 0.1", "1e-320 0.1", "line 12: expected standard deviations of at least 1e-07, got 9.99989e-321"),
        (PLANAR, "3.1622776601683795 0.02", "-3 0.02", "line 12: range: expected a number > 0"),
        (PLANAR, "1.3157749899217608 900", "1.3 -1", "line 10: I11: expected a positive definite matrix"),
        (PLANAR, "EDGE_SE2_PRIOR 2", "EDGE_SE2_PRIOR 5", "line 8: pose: there is no pose 5"),
        (SPATIAL, "1 9 4 4 -3", "1 9 7 4 -3", "line 6: offset: there is no offset 7"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            read_g2o(written(tmp_path, text.replace(old, new, 1)))


def test_landmarks_that_nobody_saw_are_left_out_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    read_g2o(written(tmp_path, PLANAR))
    assert caplog.text == ""
    graph = read_g2o(written(tmp_path, PLANAR.replace("VERTEX_XY 11", "VERTEX_XY 12 1 1\nVERTEX_XY 11")))
    assert graph.landmarks is not None
    assert graph.landmarks.ids.tolist() == [10, 11]
    assert "graph.g2o: VERTEX_XY 12 is left out, no measurement is of it (1 so)" in caplog.text
    alone = "\n".join(line for line in PLANAR.splitlines() if line.startswith(("VERTEX", "EDGE_SE2 ")))
    assert read_g2o(written(tmp_path, alone)).landmarks is None
    assert "VERTEX_XY 10 is left out, no measurement is of it (2 so)" in caplog.text


def test_a_single_bearing_does_not_determine_a_landmark(tmp_path: Path) -> None:
    lines = [line for line in PLANAR.splitlines() if not line.startswith(("EDGE_BEARING_SE2_XY 2", "VERTEX_XY"))]
    with pytest.raises(InputError, match="landmark 11: expected bearings that cross"):
        read_g2o(written(tmp_path, "\n".join(lines) + "\n"))


def test_correlated_range_and_bearing_are_not_written_as_if_independent(tmp_path: Path) -> None:
    graph = read_g2o(written(tmp_path, PLANAR))
    assert graph.landmarks is not None
    seen = list(graph.landmarks.observations)
    seen[2] = replace(seen[2], information=np.array([[[4, 1.5], [1.5, 2]]]))
    with pytest.raises(InputError, match="pose 3, landmark 10: expected range and bearing of independent errors"):
        write_g2o(tmp_path / "again.g2o", replace(graph, landmarks=replace(graph.landmarks, observations=tuple(seen))))
    assert not (tmp_path / "again.g2o").exists()

"""Files of pose graphs and landmarks."""

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path

import gtsam
import numpy as np
import pytest

from benchmarks.pose_graphs import city, torus
from data_tools.files.readers import TextTable
from data_tools.pose_graphs import read_g2o, write_g2o
from saga_fg import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.pose_graph import PoseGraph, factor_graph, optimise_poses, pose_values
from tests.pipelines.command import done

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


def test_poses_in_the_plane_are_read_in_the_order_of_their_ids(tmp_path):
    graph = read_g2o(written(tmp_path, PLANAR))
    assert graph.dim == 2
    assert graph.ids.tolist() == [3, 7]
    assert (graph.first.tolist(), graph.second.tolist()) == ([0], [1])
    np.testing.assert_allclose(graph.world_T_pose[1], [[0, -1, 1], [1, 0, 0], [0, 0, 1]], atol=1e-15)
    np.testing.assert_array_equal(graph.first_T_second[0, :2, 2], [1.5, 0.25])
    np.testing.assert_array_equal(graph.information[0], [[4, 1, 0.5], [1, 5, 0.25], [0.5, 0.25, 6]])


def test_information_in_space_is_reordered_to_rotation_first(tmp_path):
    graph = read_g2o(written(tmp_path, SPATIAL))
    assert graph.dim == 3
    np.testing.assert_array_equal(np.diag(graph.information[0]), [14, 15, 16, 11, 12, 13])
    assert graph.information[0, 2, 5] == 2.0  # z with the turn about z
    assert graph.information[0, 3, 4] == 1.0  # x with y
    np.testing.assert_allclose(graph.world_T_pose[1, :3, 0], [0.28, 0.96, 0], atol=1e-15)


@pytest.mark.parametrize(("text", "spatial"), [(PLANAR, False), (SPATIAL, True)])
def test_gtsam_reads_the_same(tmp_path, text, spatial):
    path = written(tmp_path, "\n".join(line for line in text.splitlines() if not line.startswith(("#", "FIX"))) + "\n")
    theirs, values = gtsam.readG2o(str(path), spatial)
    graph = read_g2o(path)
    ours = factor_graph(graph).error(pose_values(graph.world_T_pose))
    assert ours == pytest.approx(gtsam.NonlinearFactorGraph(theirs).error(values), rel=1e-9)


def test_what_is_wrong_is_located(tmp_path, subtests):
    for text, old, new, message in [
        (PLANAR, "VERTEX_SE2 3", "VERTEX_XYZ 3", "line 2: unknown record 'VERTEX_XYZ'; did you mean .* be removed"),
        (PLANAR, "3 0 0 0", "3 0 0", "line 2: expected 4 values after VERTEX_SE2, got 3"),
        (PLANAR, "3 0 0 0", "3 0 nan 0", "line 2: y: expected a finite number, got 'nan'"),
        (PLANAR, "3 0 0 0", "3 0 1e300 0", r"line 2: y: expected a number within 1e\+09, got 1e\+300"),
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


def test_a_file_of_measurements_alone_starts_at_dead_reckoning(tmp_path):
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


def test_slightly_indefinite_information_is_projected_with_a_warning(tmp_path, caplog):
    graph = read_g2o(written(tmp_path, PLANAR.replace("4 1 0.5 5 0.25 6", "4 2.00001 0 1 0 6")))
    values = np.linalg.eigvalsh(graph.information[0])
    assert 0 < values[0] < 1e-8
    np.testing.assert_allclose(graph.information[0], [[4, 2, 0], [2, 1, 0], [0, 0, 6]], atol=1e-4)
    assert "line 6: smallest eigenvalue -8" in caplog.text
    assert "1 information matrices" in caplog.text


def test_clearly_indefinite_information_is_projected_on_request(tmp_path, caplog):
    path = written(
        tmp_path,
        PLANAR.replace("4 1 0.5 5 0.25 6", "4 9 0 5 0 6")
        + "EDGE_PRIOR_SE2_XY 3 1 2 1 2 1\nEDGE_PRIOR_SE2_XY 7 2 3 1 0 1\n",
    )
    with pytest.raises(InputError, match=r"line 6: I11 .* smallest eigenvalue -4\.51; --project \(Python: project\)"):
        read_g2o(path)
    graph = read_g2o(path, project=True)
    for matrix, given in (
        (graph.information[0][:2, :2], [[4, 9], [9, 5]]),
        (graph.places.information[0], [[1, 2], [2, 1]]),
    ):
        values, vectors = np.linalg.eigh(given)
        np.testing.assert_allclose(matrix, np.outer(vectors[:, 1], vectors[:, 1]) * values[1], atol=1e-6)
        assert np.linalg.eigvalsh(matrix)[0] > 0
    assert caplog.text.count("so of 1 information matrices, which are made positive definite") == 2
    assert "3 measurements" in done("slam", "g2o", path, "--project", "--output", tmp_path / "out").output
    with pytest.raises(InputError, match=r"line 6: I11 .* smallest eigenvalue -6$"):  # nothing of it is left
        read_g2o(written(tmp_path, PLANAR.replace("4 1 0.5 5 0.25 6", "-4 0 0 -5 0 -6")), project=True)


def test_missing_files_and_known_places_of_no_pose_are_named(tmp_path):
    with pytest.raises(InputError, match=r"none\.g2o: cannot be read"):
        read_g2o(tmp_path / "none.g2o")
    with pytest.raises(InputError, match="line 7: pose: there is no pose 5"):
        read_g2o(written(tmp_path, PLANAR + "EDGE_PRIOR_SE2_XY 5 1 2 4 1 9\n"))


@pytest.mark.parametrize(("fixed", "warned"), [("FIX 3", False), ("FIX 7", True), ("FIX 3 7", True)])
def test_poses_that_are_not_held_as_the_file_says_are_warned_of(tmp_path, caplog, fixed, warned):
    read_g2o(written(tmp_path, PLANAR.replace("FIX 3", fixed)))
    assert ("FIX 7 has no effect, as pose 3, the first, is held" in caplog.text) == warned


PLANAR_PLACES = PLANAR + "EDGE_PRIOR_SE2_XY 3 1 2 4 1 9\nEDGE_PRIOR_SE2_XY 7 2.5 2.25 4 0 4\n"
SPATIAL_PLACES = SPATIAL + "EDGE_SE3_XYZ_PRIOR 1 0 1 2 3 4 0 1 5 0 6\n"


def test_known_places_are_read(tmp_path):
    graph = read_g2o(written(tmp_path, PLANAR_PLACES))
    assert graph.anchored
    np.testing.assert_array_equal(graph.ids[graph.places.pose], [3, 7])
    np.testing.assert_array_equal(graph.places.position, [[1, 2], [2.5, 2.25]])
    np.testing.assert_array_equal(graph.places.information[0], [[4, 1], [1, 9]])
    spatial = read_g2o(written(tmp_path, SPATIAL_PLACES)).places
    np.testing.assert_array_equal(spatial.information[0], [[4, 0, 1], [0, 5, 0], [1, 0, 6]])


# Landmarks and priors of g2o files: read, optimised, written; what is wrong is located

PLANAR_LANDMARKS = """\
VERTEX_SE2 1 5.1 2.9 0.4
VERTEX_SE2 2 6.9 3.1 0.6
VERTEX_SE2 3 6.9 5.1 2.0
VERTEX_XY 10 8 8
VERTEX_XY 11 4 7
EDGE_SE2 1 2 1.7551651237807455 -0.958851077208406 0.0 100 0 0 100 0 400
EDGE_SE2 2 3 0.958851077208406 1.7551651237807455 1.5 100 0 0 100 0 400
EDGE_SE2_PRIOR 2 7 3 0.5 100 0 0 100 0 400
EDGE_SE2_XY 1 10 5.029875378692133 2.9496361936392548 25 0 25
EDGE_SE2_XY 1 11 1.0401195925264393 3.989755786165694 25 0 25
EDGE_SE2_XY 2 11 -0.7150455312543063 4.9486068633741 25 0 25
EDGE_SE2_XY 3 10 2.3117454439299023 -2.157737936467109 4 1.5 2
"""
SPATIAL_LANDMARKS = """\
PARAMS_SE3OFFSET 4 0 0 0.5 0 0 0.7071067811865476 0.7071067811865476
VERTEX_SE3:QUAT 1 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 2 2.1 0.1 0 0 0 0 1
VERTEX_TRACKXYZ 9 3.2 4 1
EDGE_SE3:QUAT 1 2 2 0 0 0 0 0 1 100 0 0 0 0 0 100 0 0 0 0 100 0 0 0 400 0 0 400 0 400
EDGE_SE3_TRACKXYZ 1 9 4 4 -3 0.5 1 0 0 4 0 9
EDGE_SE3_TRACKXYZ 2 9 4 4 -1 0.5 1 0 0 4 0 9
EDGE_SE3_PRIOR 1 4 5 0 0.5 0 0 0.7071067811865476 0.7071067811865476 100 0 0 0 0 0 50 0 0 0 0 100 0 0 0 400 0 0 400 0 400
"""  # noqa: E501


def test_all_planar_records_agree_on_one_world(tmp_path):
    """The measurements are those of the poses (5.0, 3.0, 0.5) ..., so the optimum has no error."""
    graph = read_g2o(written(tmp_path, PLANAR_LANDMARKS))
    assert len(graph.landmarks.pose) == 4
    assert graph.landmarks.position.tolist() == [[8, 8], [4, 7]]
    optimised = optimise_poses(graph)
    assert optimised.error < 1e-9
    np.testing.assert_allclose(optimised.world_T_pose[:, :2, 2], [[5, 3], [7, 3], [7, 5]], atol=1e-6)
    assert optimised.landmarks is not None
    np.testing.assert_allclose(optimised.landmarks, [[8, 8], [4, 7]], atol=1e-6)
    assert optimised.covariances().shape == (3, 3, 3)
    assert max(optimised.errors.values()) < 1e-9


def arrays(value):
    """All arrays of a graph, by their names."""
    for field in fields(value):
        part = getattr(value, field.name)
        if is_dataclass(part):
            yield from ((f"{field.name}.{name}", inner) for name, inner in arrays(part))
        elif isinstance(part, np.ndarray):
            yield field.name, part


@pytest.mark.parametrize("text", [PLANAR_PLACES, SPATIAL_PLACES, PLANAR_LANDMARKS, SPATIAL_LANDMARKS])
def test_writing_and_reading_gives_the_same_graph(tmp_path, text):
    graph = read_g2o(written(tmp_path, text))
    write_g2o(tmp_path / "again.g2o", graph)
    found, expected = dict(arrays(read_g2o(tmp_path / "again.g2o"))), dict(arrays(graph))
    assert found.keys() == expected.keys()
    for name, array in expected.items():
        np.testing.assert_allclose(found[name], array, rtol=1e-12, atol=1e-12, err_msg=name)


def test_offsets_of_sensors_are_taken_into_the_measurements(tmp_path):
    """A sensor half a metre up, turned to the left, sees the landmark (3, 4, 1) at (4, -3, 0.5)."""
    graph = read_g2o(written(tmp_path, SPATIAL_LANDMARKS))
    np.testing.assert_allclose(graph.landmarks.z, [[3, 4, 1], [1, 4, 1]], atol=1e-12)
    np.testing.assert_allclose(np.diag(graph.landmarks.information[0]), [4, 1, 9], atol=1e-12)
    np.testing.assert_allclose(graph.priors.world_T_pose[0, :3, 3], [5, 0, 0], atol=1e-12)
    np.testing.assert_allclose(np.diag(graph.priors.information[0])[3:], [50, 100, 100], atol=1e-9)
    optimised = optimise_poses(graph)
    assert optimised.error < 1e-9
    np.testing.assert_allclose(optimised.world_T_pose[:, :3, 3], [[5, 0, 0], [7, 0, 0]], atol=1e-6)
    assert optimised.landmarks is not None
    np.testing.assert_allclose(optimised.landmarks, [[8, 4, 1]], atol=1e-6)


def test_without_vertices_landmarks_start_where_they_are_seen(tmp_path):
    edges = "\n".join(line for line in PLANAR_LANDMARKS.splitlines() if not line.startswith("VERTEX")) + "\n"
    graph = read_g2o(written(tmp_path, edges))
    assert np.isfinite(graph.landmarks.position).all()
    found = optimise_poses(graph)
    whole = optimise_poses(read_g2o(written(tmp_path, PLANAR_LANDMARKS)))
    assert found.error < 1e-9
    assert found.landmarks is not None
    assert whole.landmarks is not None
    np.testing.assert_allclose(found.landmarks, whole.landmarks, atol=1e-3)


def test_what_is_wrong_with_landmarks_is_located(tmp_path, subtests):
    for text, old, new, message in [
        (PLANAR_LANDMARKS, "EDGE_SE2_XY 1 10", "EDGE_SE2_XY 1 12", "line 9: landmark: there is no landmark 12"),
        (PLANAR_LANDMARKS, "EDGE_SE2_XY 1 10", "EDGE_SE2_XY 4 10", "line 9: pose: there is no pose 4"),
        (PLANAR_LANDMARKS, "VERTEX_XY 10", "VERTEX_XY 11", "line 5: id: 11 is given twice"),
        (PLANAR_LANDMARKS, "4 1.5 2", "4 1.5 -2", "line 12: I11 ... I22: expected a positive definite matrix"),
        (PLANAR_LANDMARKS, "EDGE_SE2_PRIOR 2", "EDGE_SE2_PRIOR 5", "line 8: pose: there is no pose 5"),
        (SPATIAL_LANDMARKS, "1 9 4 4 -3", "1 9 7 4 -3", "line 6: offset: there is no offset 7"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            read_g2o(written(tmp_path, text.replace(old, new, 1)))


def test_landmarks_that_nobody_saw_are_left_out_with_a_warning(tmp_path, caplog):
    read_g2o(written(tmp_path, PLANAR_LANDMARKS))
    assert caplog.text == ""
    graph = read_g2o(written(tmp_path, PLANAR_LANDMARKS.replace("VERTEX_XY 11", "VERTEX_XY 12 1 1\nVERTEX_XY 11")))
    assert graph.landmarks.ids.tolist() == [10, 11]
    assert "graph.g2o: VERTEX_XY 12 is left out, no measurement is of it (1 so)" in caplog.text
    alone = "\n".join(line for line in PLANAR_LANDMARKS.splitlines() if line.startswith(("VERTEX", "EDGE_SE2 ")))
    assert read_g2o(written(tmp_path, alone)).landmarks is None
    assert "VERTEX_XY 10 is left out, no measurement is of it (2 so)" in caplog.text


# Pose graphs made up: true poses fit the measurements, and the optimum's error is what statistics expect

Generator = Callable[..., tuple[PoseGraph, FloatArray]]


def test_the_optimum_has_the_expected_error_where_the_guess_is_far_off(subtests):
    for make in [city, torus]:
        with subtests.test(make=make):
            graph, true = make(200, seed=1, noise=0.15)
            optimised = optimise_poses(graph)
            k = graph.information.shape[1]
            freedom = k * (len(graph.first) - len(graph) + 1)
            assert 2 * optimised.error / freedom == pytest.approx(1, abs=6 * np.sqrt(2 / freedom))
            assert optimised.error < factor_graph(graph).error(pose_values(true))


def test_the_same_seed_makes_the_same_graph_guessed_by_dead_reckoning():
    graph, true = torus(400, seed=2, windings=10)
    steps = np.linalg.inv(graph.world_T_pose[:-1]) @ graph.world_T_pose[1:]
    np.testing.assert_allclose(steps, graph.first_T_second[:399], atol=1e-9)
    np.testing.assert_array_equal(graph.world_T_pose[0], true[0])
    for name in ("first", "second", "first_T_second"):
        np.testing.assert_array_equal(getattr(city(300, 5)[0], name), getattr(city(300, 5)[0], name))
    assert (city(300, 5)[0].first_T_second[0] != city(300, 6)[0].first_T_second[0]).any()


# Ids of poses as GTSAM's symbols are, near 2^63: read, solved and written exactly

_BUT_IDS = ("world_T_pose", "first", "second", "first_T_second", "information")


def of_two_robots() -> PoseGraph:
    """A city whose first half robot a drives, whose second half robot b."""
    graph, _ = city(20, seed=0)
    ids = [gtsam.symbol("a", row) if row < 10 else gtsam.symbol("b", row - 10) for row in range(20)]
    return PoseGraph(np.array(ids), *(getattr(graph, name) for name in _BUT_IDS))


def test_symbols_are_read_solved_and_written(tmp_path):
    graph, path = of_two_robots(), tmp_path / "robots.g2o"
    write_g2o(path, graph)
    read = read_g2o(path)
    assert read.ids.tolist() == graph.ids.tolist()
    np.testing.assert_array_equal(read.first, graph.first)
    last = gtsam.symbol("b", 9)
    arguments = ["slam", "g2o", path, "--output", tmp_path / "out", "--certify", "--covariances", last]
    done(*arguments)
    assert read_g2o(tmp_path / "out" / "poses.g2o").ids.tolist() == graph.ids.tolist()
    rows = (tmp_path / "out" / "covariances.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows[1:]] == [str(last)]


def test_a_prior_on_the_largest_id_is_solved(tmp_path):
    path, last = tmp_path / "prior.g2o", 2**63 - 1
    path.write_text(
        f"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 {last} 1 0 0\nEDGE_SE2 0 {last} 1 0 0 1 0 0 1 0 1\n"
        f"EDGE_PRIOR_SE2 {last} 5 0 0 1 0 0 1 0 1\n"
    )
    optimised = optimise_poses(read_g2o(path), certify=True)
    for poses in (optimised.world_T_pose, optimised.chordal.world_T_pose):
        np.testing.assert_allclose(poses[:, 0, 2], [4, 5], atol=1e-6)


def test_ids_are_whole_numbers_however_written_and_not_beyond(tmp_path):
    path = tmp_path / "graph.g2o"
    for wrong in ("9223372036854775808", "7e18", "1.5", "-1"):
        path.write_text(f"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 {wrong} 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
        with pytest.raises(InputError, match="line 2: id: expected a whole number from 0 to 9223372036854775807, got"):
            read_g2o(path)
    table = TextTable.from_rows(Path("table"), [["12"], ["12.0"], ["1.2e1"], ["9223372036854775807"]], [1, 2, 3, 4])
    assert table.integers(0, "id", 0, 2**63 - 1).tolist() == [12, 12, 12, 2**63 - 1]

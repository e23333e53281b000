"""`saga-fg slam g2o`: files out, figures on stdout, and the optimum on the public graphs."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.pose_graphs import from_same_starts
from data_tools.pose_graphs import read_g2o, write_g2o
from saga_fg.slam.pose_graph import chordal_minimum, chordal_poses, factor_graph, optimise_poses, pose_values
from tests.data_tools.test_pose_graphs import PLANAR
from tests.pipelines.command import done, refused
from tests.saga_fg.loops import loop

RECORDINGS = Path(os.environ.get("SAGA_FG_DATA", Path(__file__).parents[2].parent / "shared" / "data")) / "slam"


@pytest.mark.parametrize("dim", [2, 3])
def test_the_command_writes_the_optimum(tmp_path: Path, dim: int) -> None:
    graph, _ = loop(dim, seed=0)
    write_g2o(tmp_path / "loop.g2o", graph)
    output = tmp_path / "out"
    result = done("slam", "g2o", tmp_path / "loop.g2o", "--output", output)
    assert "36 poses, 59 measurements, error" in result.stdout
    written = read_g2o(output / "poses.g2o")
    errors = json.loads((output / "errors.json").read_text())
    error = factor_graph(graph).error(pose_values(written.world_T_pose))
    assert error == pytest.approx(errors[f"from the {errors['best']}"], rel=1e-9)
    assert error <= 1.01 * min(row.gtsam_error for row in from_same_starts(graph))
    rows = np.genfromtxt(output / "covariances.csv", delimiter=",", names=True)
    assert rows["id"].tolist() == graph.ids.tolist()
    assert (rows["P11"] > 0).all()
    assert (output / "above.png").read_bytes().startswith(b"\x89PNG")


def test_the_chordal_minimum_is_certified_and_some_covariances_are_written(tmp_path: Path) -> None:
    graph, _ = loop(3, seed=0)
    write_g2o(tmp_path / "loop.g2o", graph)
    edges = [line for line in (tmp_path / "loop.g2o").read_text().splitlines() if line.startswith("EDGE")]
    (tmp_path / "loop.g2o").write_text("\n".join(edges) + "\n")
    arguments = ["slam", "g2o", str(tmp_path / "loop.g2o"), "--output", str(tmp_path / "out"), "--certify"]
    result = done(*arguments, "--covariances", "120,30,120")
    assert "the global minimum: no poses below" in result.stdout
    assert "(at the start " in result.stdout  # the file has no vertices, so there is no guess in it
    found = json.loads((tmp_path / "out" / "errors.json").read_text())
    assert found["chordal"]["certified"]
    assert found["from the chordal minimum"] == pytest.approx(found[f"from the {found['best']}"], rel=1e-6)
    rows = np.genfromtxt(tmp_path / "out" / "covariances.csv", delimiter=",", names=True)
    assert rows["id"].tolist() == [120, 30]
    whole = optimise_poses(read_g2o(tmp_path / "loop.g2o")).covariances()
    np.testing.assert_allclose(rows["P11"], whole[[12, 3], 0, 0], rtol=1e-6)
    arguments[4] = str(tmp_path / "none")
    done(*arguments, "--covariances", "none")
    assert not (tmp_path / "none" / "covariances.csv").exists()


def test_a_graph_in_pieces_is_refused_by_the_name_of_its_file(tmp_path: Path) -> None:
    file, output = tmp_path / "pieces.g2o", tmp_path / "out"
    poses = "".join(f"VERTEX_SE2 {k} {k} 0 0\n" for k in (3, 4, 7))
    file.write_text(poses + "EDGE_SE2 3 4 1 0 0 1 0 0 1 0 1\n")
    said = refused("slam", "g2o", file, "--output", output)
    assert said.startswith(f"error: {file}: pose 7: expected measurements that connect it")
    assert not output.exists()


@pytest.mark.parametrize("place", [1e8, 1e9])
def test_a_measurement_across_a_country_has_its_covariance(tmp_path: Path, place: float) -> None:
    """The first pose is held to 1e-4 rad, which is kilometres at the other end."""
    file, output = tmp_path / "far.g2o", tmp_path / "out"
    file.write_text(f"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 {place} 0 0 100 0 0 100 0 400\n")
    done("slam", "g2o", file, "--output", output)
    rows = np.genfromtxt(output / "covariances.csv", delimiter=",", names=True)
    assert rows["P22"][1] == pytest.approx(place**2 * 1e-8 + 1 / 100, rel=1e-6)
    assert rows["P33"][1] == pytest.approx(1e-8 + 1 / 400, rel=1e-6)


def test_landmarks_and_priors_are_compared_with_gtsams_own_factors(tmp_path: Path) -> None:
    (tmp_path / "graph.g2o").write_text(PLANAR)
    rows = from_same_starts(read_g2o(tmp_path / "graph.g2o"))
    assert [row.start for row in rows] == ["guess", "chordal"]
    for row in rows:
        assert (row.error, row.gtsam_error) == pytest.approx((0, 0), abs=1e-6)


def test_a_robust_loss_takes_care_of_false_loops(tmp_path: Path) -> None:
    graph, truth = loop(2, seed=0)
    wrong = graph.first_T_second.copy()
    false = np.flatnonzero(np.abs(graph.second - graph.first) > 1)[:3]
    wrong[false, :2, 2] += [7.0, -5.0]
    write_g2o(tmp_path / "false.g2o", replace(graph, first_T_second=wrong))
    off = {}
    for name, options in (
        ("plain", []),
        ("robust", ["--robust", "geman-mcclure"]),
        ("consensus", ["--robust", "consensus"]),
    ):
        output = tmp_path / name
        done("slam", "g2o", tmp_path / "false.g2o", "--output", output, *options)
        found = read_g2o(output / "poses.g2o").world_T_pose
        found = np.linalg.inv(found[0]) @ found
        off[name] = np.abs((found - np.linalg.inv(truth[0]) @ truth)[:, :2, 2]).max()
    assert off["robust"] < 0.3 * off["plain"]
    assert off["consensus"] < 0.3 * off["plain"]
    errors = {name: json.loads((tmp_path / name / "errors.json").read_text()) for name in ("plain", "consensus")}
    assert errors["consensus"]["guess itself"] == pytest.approx(errors["plain"]["guess itself"], rel=1e-12)
    named = [f"{graph.ids[graph.first[k]]} {graph.ids[graph.second[k]]}" for k in false]
    rejected = json.loads((tmp_path / "consensus" / "errors.json").read_text())["rejected"]
    assert set(named) <= set(rejected)
    assert len(rejected) <= len(named) + 1


def test_options_that_do_not_go_together(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for options, message in [
        (["--robust", "huber", "--certify"], "--certify: expected without a robust loss"),
        (
            ["--covariances", "10,elephant"],
            "--covariances: expected all, last, none or ids of poses with commas, got 'e",
        ),
        (["--covariances", "last,10"], "--covariances: expected last alone or ids of poses with commas, got 'last,10'"),
    ]:
        with subtests.test(message):
            graph, _ = loop(2, seed=0)
            write_g2o(tmp_path / "loop.g2o", graph)
            arguments = ["slam", "g2o", str(tmp_path / "loop.g2o"), "--output", str(tmp_path / "out"), *options]
            assert message in refused(*arguments)


@pytest.mark.skipif(not RECORDINGS.exists(), reason="the public pose graphs are not there (SAGA_FG_DATA)")
@pytest.mark.parametrize(
    ("name", "cost"),
    [("CSAIL", 31.7037), ("intel", 48.4467), ("MIT", 61.1541), ("smallGrid3D", 1025.40), ("sphere2500", 1687.01)],
)
def test_the_chordal_minimum_of_public_graphs_is_that_of_the_literature(name: str, cost: float) -> None:
    graph = read_g2o(RECORDINGS / f"{name}.g2o")
    minimum = chordal_minimum(graph, chordal_poses(graph))
    assert minimum.certified
    assert minimum.cost == pytest.approx(cost, rel=1e-5)


@pytest.mark.skipif(not RECORDINGS.exists(), reason="the public pose graphs are not there (SAGA_FG_DATA)")
@pytest.mark.parametrize("name", ["intel", "MIT", "parking-garage", "sphere2500"])
def test_public_graphs_reach_the_lower_of_gtsams_errors(name: str) -> None:
    graph = read_g2o(RECORDINGS / f"{name}.g2o")
    optimised = optimise_poses(graph)
    assert optimised.error <= 1.01 * min(row.gtsam_error for row in from_same_starts(graph))
    if name == "MIT":  # where the guess in the file leads astray
        assert optimised.errors["guess"] > 10 * optimised.error

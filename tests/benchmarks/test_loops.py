"""`python -m benchmarks loops`: false loops, simulated courses, and what is refused before anything runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.app import app
from benchmarks.course import SimulatedCourse, revisits
from benchmarks.loops import odometry_of
from data_tools.pose_graphs import write_g2o
from saga_fg.slam.pose_graph import PoseGraph, PosePriors
from tests.saga_fg.loops import loop


def spoilt(folder: Path, graph: PoseGraph, *options: str) -> tuple[int, str, str]:
    sound, _ = loop(2, seed=0)
    write_g2o(folder / "sound.g2o", sound)
    write_g2o(folder / "other.g2o", graph)
    files = [str(folder / name) for name in ("sound.g2o", "other.g2o")]
    result = CliRunner().invoke(app, ["loops", *files, "--no-gnc", "--seeds", "1", *options])
    return result.exit_code, result.stdout, result.stderr


def test_false_loops_are_left_out(tmp_path: Path) -> None:
    code, stdout, stderr = spoilt(tmp_path, loop(2, seed=1)[0], "--shares", "0.2")
    assert code == 0, stderr
    assert "sound, 0.2" in stdout
    assert "other, 0.2" in stdout


def triangle() -> PoseGraph:
    graph, true = loop(2, seed=0)
    first, second = np.array([0, 1, 0]), np.array([1, 2, 2])
    return PoseGraph(
        graph.ids[:3], true[:3], first, second, np.linalg.inv(true[first]) @ true[second], graph.information[:3]
    )


def with_prior() -> PoseGraph:
    graph, true = loop(2, seed=0)
    return replace(graph, priors=PosePriors(np.array([0]), true[:1], np.eye(3)[None]))


def test_what_cannot_be_run_is_refused_at_the_door(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for graph, options, message in [
        (triangle(), [], "other.g2o: expected 4 poses and a loop or more, got 3 and 1"),
        (with_prior(), [], "other.g2o: expected a graph of poses alone, without landmarks and priors"),
        (loop(2, seed=1)[0], ["--shares", "-1"], "--shares: expected numbers >= 0 with commas, got '-1'"),
        (loop(2, seed=1)[0], ["--shares", "inf"], "--shares: expected numbers >= 0 with commas, got 'inf'"),
    ]:
        with subtests.test(message):
            code, stdout, stderr = spoilt(tmp_path, graph, *options)
            assert code == 2
            assert message in stderr.replace("\n", " ")
            assert not stdout


def test_odometry_errs_by_one_per_cent_and_the_drift_asked_for() -> None:
    ends = []
    for seed in range(3):
        course = SimulatedCourse(seed, period=0.25)
        poses, drifted = (odometry_of(course, seed, drift) for drift in (0.0, 30.0))
        first = revisits(course.world_T_ego)[0][0]
        assert np.linalg.norm((drifted - poses)[first, :3, 3]) == pytest.approx(30.0)
        ends.append(np.linalg.norm((poses - course.world_T_ego)[:, :3, 3], axis=1).max() / course.distance[-1])
    assert 0.005 < np.median(ends) < 0.03


def test_courses_that_cannot_be_driven_are_refused(refused, subtests: pytest.Subtests) -> None:
    for arguments, message in [
        ("", "expected either files of pose graphs, or --courses"),
        ("--courses a", "--courses: expected numbers >= 0 with commas, got 'a'"),
        ("--courses 0 --drift -1", "--drift: expected numbers >= 0 with commas"),
        ("graph.g2o --courses 0", "expected either files of pose graphs, or --courses"),
    ]:
        with subtests.test(message):
            assert message in refused(f"loops {arguments}")

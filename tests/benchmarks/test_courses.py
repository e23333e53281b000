"""Simulated courses for loops: how far their odometry drifts, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.app import app
from benchmarks.courses import odometry_of
from data_tools.simulator.course import SimulatedCourse, revisits


def test_odometry_errs_by_one_per_cent_and_the_drift_asked_for() -> None:
    ends = []
    for seed in range(6):
        course = SimulatedCourse(seed, period=0.25)
        poses, drifted = (odometry_of(course, seed, drift) for drift in (0.0, 30.0))
        first = revisits(course.world_T_ego)[0][0]
        assert np.linalg.norm((drifted - poses)[first, :3, 3]) == pytest.approx(30.0)
        ends.append(np.linalg.norm((poses - course.world_T_ego)[:, :3, 3], axis=1).max() / course.way[-1])
    assert 0.005 < np.median(ends) < 0.03


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "expected files of pose graphs, or --courses"),
        (["--courses", "a"], "--courses: expected numbers with commas, got 'a'"),
        (["--courses", "0", "--drift", "-1"], "--drift: expected numbers >= 0 with commas"),
        (["graph.g2o", "--courses", "0"], "--courses: expected no files besides"),
    ],
)
def test_what_cannot_be_run_is_refused(arguments: list[str], message: str) -> None:
    result = CliRunner().invoke(app, ["loops", *arguments])
    assert result.exit_code == 2
    assert message in " ".join(result.stderr.split())

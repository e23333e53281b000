"""Factors and landmarks of users' own reach `saga-fg slam` through its configuration."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.scans import SimulatedScans
from data_tools.trajectories import read_tum_poses
from tests.pipelines.command import done, refused

# a GPS that says how far the drive really went, and the one post that stands beside the road
MODULE = """
import gtsam
import numpy as np

from saga_fg.graph import EGO_POSE, Additions
from saga_fg.types.frame import Observation
from saga_fg.model.landmarks import PoleLandmark


class Gps:
    name = "gps"

    def factors(self, view):
        place = np.array([2.0 * view.time, 0.0, 0.0])
        noise = gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)
        return Additions(factors=[gtsam.GPSFactor(view.key(EGO_POSE, 0), place, noise)])


class Posts:
    kind = PoleLandmark(name="post")

    def observations(self, points):
        return [Observation(self.kind, np.array([6.0, -9.0, 0.0]), 0.01 * np.eye(2))]
"""


@pytest.fixture
def drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of scans, and the module beside it."""
    (tmp_path / "scans").mkdir()
    scans = SimulatedScans(0, 8)
    for row in range(len(scans)):
        np.save(tmp_path / "scans" / f"{row:04d}.npy", scans[row].points)
    (tmp_path / "own_slam_parts.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "own_slam_parts", raising=False)
    return tmp_path


def command(folder: Path, name: str, config: str) -> list[object]:
    (folder / "slam.yaml").write_text(config)
    return ["slam", "scans", folder / "scans", "--output", folder / name, "--config", folder / "slam.yaml"]


def test_a_factor_provider_moves_the_path(drive: Path) -> None:
    done(*command(drive, "gps", "slam: {providers: ['own_slam_parts:Gps']}"))
    path = read_tum_poses(drive / "gps" / "trajectory.tum")
    np.testing.assert_allclose(path.positions[-1, 0], 2.0 * path.timestamps[-1], atol=0.3)


def test_a_kind_of_landmark_of_ones_own_is_in_the_map(drive: Path) -> None:
    done(*command(drive, "posts", "slam: {landmarks: ['own_slam_parts:Posts'], lidar: {submaps: {confirm_after: 1}}}"))
    marks = json.loads((drive / "posts" / "landmarks.json").read_text())
    assert "post" in {mark["kind"] for mark in marks}


def test_what_cannot_be_is_refused(drive: Path, subtests: pytest.Subtests) -> None:
    for config, message in [
        ("slam: {providers: [wall]}", "providers: expected MODULE:NAME, got 'wall'"),
        (
            "slam: {landmarks: ['collections:Counter']}",
            "expected a detector of landmarks with observations; it lacks observations",
        ),
        ("tracker: {estimator: isam2, providers: ['a:B']}", "tracker.providers: expected under slam"),
        ("slam: {lidar: {rounds: 0}}", "slam.lidar"),
    ]:
        with subtests.test(message):
            assert message in refused(*command(drive, "out", config))
            assert not (drive / "out").exists()

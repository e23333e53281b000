"""Factors and landmarks of users' own reach `saga-fg slam` through its configuration."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from data_tools.trajectories import read_tum_poses
from pipelines.cli import app

# a GPS without errors, and posts on both sides of the road, seen by a camera that knows where they are
MODULE = """
import gtsam
import numpy as np

from factors import pose_prior_factor
from saga_fg.numerics.geometry import inverse_transform, transform_points
from saga_fg.graph import EGO_POSE, Additions
from saga_fg.types.landmark import Observation
from saga_fg.model.landmarks import PoleLandmark

TRUTH = np.load("{truth}")


class Gps:
    name = "gps"

    def factors(self, view):
        pose = TRUTH[np.argmin(np.abs(TRUTH[:, 0, 4] - view.time))][:, :4]
        return Additions(factors=[pose_prior_factor(view.key(EGO_POSE, 0), pose, 1e-4 * np.eye(6))])


class Posts:
    kind = PoleLandmark(name="post")

    def observations(self, frame):
        places = np.array([[x, y, 1.0] for x in (5.0, 25.0, 45.0) for y in (-9.0, 9.0)])
        here = transform_points(TRUTH[0, :, :4], places)
        seen = transform_points(inverse_transform(frame.world_T_ego), here)
        return [Observation(self.kind, z, 1e-4 * np.eye(2)) for z in seen if np.hypot(*z[:2]) < 40.0]
"""


@pytest.fixture
def street(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A drive with the settings as shipped, and the module beside it, which knows the truth of that drive."""
    run(tmp_path / "plain")
    truth = read_tum_poses(tmp_path / "plain" / "truth.tum")
    poses = np.concatenate([truth.world_T_ego, np.broadcast_to(truth.timestamps[:, None, None], (len(truth), 4, 1))], 2)
    np.save(tmp_path / "truth.npy", poses)
    (tmp_path / "own_slam_parts.py").write_text(MODULE.replace("{truth}", str(tmp_path / "truth.npy")))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "own_slam_parts", raising=False)
    return tmp_path


def run(output: Path, config: str | None = None, *options: str) -> Result:
    arguments = ["--seed", "2", "--duration", "3", "--output", str(output), *options]
    if config is not None:
        path = output.parent / "slam.yaml"
        path.write_text(config)
        arguments += ["--config", str(path)]
    return CliRunner().invoke(app, ["slam", "simulated", *arguments])


def ate(output: Path, path: str = "joint") -> float:
    return float(json.loads((output / "errors.json").read_text())[path]["ate"])


def test_a_factor_provider_acts_in_the_batch_and_online(street: Path) -> None:
    done = run(street / "gps", "slam: {providers: ['own_slam_parts:Gps']}", "--online", "--lag", "1")
    assert done.exit_code == 0, done.output
    assert ate(street / "gps") < 0.01 < ate(street / "plain")
    assert ate(street / "gps", "online") < 0.02


def test_a_kind_of_landmark_is_found_and_holds_the_path(street: Path) -> None:
    done = run(street / "posts", "slam: {landmarks: ['own_slam_parts:Posts']}")
    assert done.exit_code == 0, done.output
    posts = json.loads((street / "posts" / "landmarks.json").read_text())
    assert {post["kind"] for post in posts} == {"post"}
    assert len(posts) == 6
    assert ate(street / "posts") < ate(street / "plain")
    assert json.loads((street / "plain" / "landmarks.json").read_text()) == []


def test_what_cannot_be_is_refused(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for config, message in [
        ("slam: {providers: [wall]}", "providers: expected MODULE:NAME, got 'wall'"),
        ("slam: {landmarks: ['collections:Counter']}", "expected a detector of landmarks, which has a method"),
        ("tracker: {estimator: isam2, providers: ['a:B']}", "tracker.providers: expected under slam"),
        ("slam: {joint: {rounds: 0}}", "slam.joint"),
    ]:
        with subtests.test(message):
            done = run(tmp_path / "out", config)
            assert done.exit_code == 2
            assert message in done.output
            assert not (tmp_path / "out").exists()

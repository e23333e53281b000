"""`saga-fg slam simulated`: the vehicle and the objects around it together."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from data_tools.simulator import simulate_scene
from data_tools.trajectories import read_kitti_poses, read_tum_poses
from pipelines.cli import app
from pipelines.config import load_config
from pipelines.slam.joint import keyframes, run_joint, street
from saga_fg import InputError
from saga_fg.slam.joint import JointSettings
from tests.pipelines.command import done

SHORT = replace(street(), duration=2.0)


def test_a_simulated_street(tmp_path: Path) -> None:
    output = tmp_path / "street"
    options = ["--seed", "2", "--duration", "2", "--online", "--lag", "0.5"]
    street = done("slam", "simulated", *options, "--output", output)
    assert "ATE: odometry" in street.output
    assert "settled (lag 0.5 s): ATE" in street.output
    errors = json.loads((output / "errors.json").read_text())
    assert errors["joint"]["poses"] == errors["odometry"]["poses"]
    joint = read_tum_poses(output / "joint.tum")
    for name in ("online", "settled"):
        assert len(read_tum_poses(output / f"{name}.tum")) == len(joint) == errors[name]["poses"]
    kitti = read_kitti_poses(output / "joint.txt", output / "times.txt")
    np.testing.assert_allclose(kitti.world_T_ego, joint.world_T_ego, atol=1e-6)
    assert {line.split(",")[2] for line in (output / "tracks.csv").read_text().splitlines()[1:]} >= {"car"}
    tracks = np.loadtxt(output / "tracks.csv", delimiter=",", skiprows=1, usecols=[0, 1, *range(3, 11)])
    assert (tracks[:, 6:] > 0).all()
    covariances = np.loadtxt(output / "covariances.csv", delimiter=",", skiprows=1)
    assert covariances.shape == (len(joint), 22)
    assert (output / "above.png").stat().st_size > 1000


def test_a_window_without_the_online_estimate_is_refused(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["slam", "simulated", "--lag", "2", "--output", str(tmp_path / "street")])
    assert done.exit_code != 0
    assert "--lag 2: expected with --online only" in done.output
    assert not list(tmp_path.iterdir())


def test_keyframes_lie_apart_in_time() -> None:
    frames = [frame for frame in simulate_scene(SHORT, 1).frames if frame.sensor == "lidar"]
    chosen = keyframes(frames, 0.25)
    assert len(chosen) < len(frames) / 2
    assert min(b.timestamp - a.timestamp for a, b in pairwise(chosen)) > 0.25


def test_a_sensor_without_frames_is_named() -> None:
    with pytest.raises(InputError, match="expected frames of radar, there are those of"):
        run_joint(simulate_scene(SHORT, 1, "s"), load_config("simulated"), JointSettings(), "radar", 0)

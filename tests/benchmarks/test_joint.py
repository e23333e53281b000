"""`python -m benchmarks joint`: joint against decoupled estimation, in batch and online."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.app import app
from benchmarks.joint import JointBench, bench_joint
from benchmarks.joint_online import bench_online
from benchmarks.simulated_poles import observe_poles
from data_tools.simulator import simulate_scene
from pipelines.config import load_config
from pipelines.slam.joint import run_joint, street
from saga_fg import InputError
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.slam.joint import JointSettings

SHORT = replace(street(), duration=2.0)


def test_the_benchmark_pools_recordings_and_compares_the_same_odometry() -> None:
    scenes = [simulate_scene(SHORT, seed, f"street {seed}") for seed in (1, 2)]
    settings = JointSettings(passes=1, keyframe_period=0.15)
    config = load_config("simulated")
    told: list[JointBench] = []
    result = bench_joint(scenes, config, [0], settings, poles=True, so_far=told.append)
    assert [len(part.rows) for part in told] == [1, 2]
    assert told[-1] == result
    assert [row.scene for row in result.rows] == ["street 1", "street 2"]
    for scene, row in zip(scenes, result.rows, strict=True):
        errors = run_joint(scene, config, settings, "lidar", 0).errors()
        assert (row.decoupled_ate, row.joint_ate) == (errors["odometry"].ate, errors["joint"].ate)
    square = [(row.joint_ate**2, row.decoupled_ate**2) for row in result.rows]
    joint_square, decoupled_square = np.sum(square, axis=0)
    assert result.landmarks is not None
    assert all(np.isfinite(row.landmarks_ate) for row in result.rows)
    assert result.change.estimate == pytest.approx(np.sqrt(joint_square / decoupled_square) - 1)


def test_options_of_the_benchmark_go_together() -> None:
    done = CliRunner().invoke(app, ["joint", "--dataroot", "somewhere"])
    assert done.exit_code != 0
    assert "expected both --dataroot and --detections" in done.output


def test_online_objects_are_scored_where_both_report_them() -> None:
    scenes = [simulate_scene(replace(SHORT, duration=3.0), seed, f"street {seed}") for seed in (1, 2)]
    config = load_config("simulated")
    result = bench_online(scenes, config, [0], lag=1.0)
    for scene, row in zip(scenes, result.rows, strict=True):
        run = run_joint(scene, config, JointSettings(), "lidar", 0, lag=1.0)
        assert row.ate == (run.errors()["odometry"].ate, run.errors()["online"].ate)
        assert {(one.contender, one.moving) for one in row.objects} == {
            (name, moving) for name in ("decoupled", "joint") for moving in (True, False)
        }
        for one in row.objects:
            assert one.pairs > 5
            assert 0 < one.rmse[1] < 5
            assert 0 < one.rmse[2] < 1
    moving = [one for row in result.rows for one in row.objects if one.moving]
    squares = {
        name: sum(x.pairs * x.rmse[0] ** 2 for x in moving if x.contender == name) for name in ("decoupled", "joint")
    }
    change = next(one for one in result.objects if one.moving)
    assert change.changes[0].estimate == pytest.approx(np.sqrt(squares["joint"] / squares["decoupled"]) - 1)


def test_the_online_benchmark_prints_both_and_wants_the_truth() -> None:
    scene = replace(simulate_scene(SHORT, 1), ground_truth=None)
    with pytest.raises(InputError, match="expected ground truth"):
        bench_online([scene], load_config("simulated"), [0], lag=1.0)
    done = CliRunner().invoke(app, ["joint", "--online", "--poles"])
    assert "--online: expected neither --poles nor --lanes" in done.output


def test_the_command_prints_and_writes_the_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipelines.slam.joint.street", lambda parked, mapped: SHORT)
    for option, expected in (("--poles", "joint against held"), ("--online", "pooled, 95 % interval")):
        file = tmp_path / f"{option}.json"
        done = CliRunner().invoke(app, ["joint", "--scenes", "2", option, "--json", str(file)])
        assert done.exit_code == 0, done.output
        assert expected in done.stdout
        assert len(json.loads(file.read_text())["rows"]) == 2


def test_poles_are_seen_within_reach_with_the_noise_stated() -> None:
    poses = np.stack([yaw_transform(0.5 * k) for k in range(60)])
    seen = observe_poles(poses, 1, reach=20.0)
    assert len(seen) == len(poses)
    places = np.array([pose[:2, 3] + o.value[:2] for pose, now in zip(poses, seen, strict=True) for o in now])
    assert max(np.hypot(*o.value[:2]) for now in seen for o in now) < 21
    first = places[np.linalg.norm(places - places[0], axis=1) < 2]
    assert 0.05 < first.std(axis=0).mean() < 0.2
    again = observe_poles(poses, 1, reach=20.0)
    assert [len(now) for now in seen] == [len(now) for now in again]

"""`python -m benchmarks joint`: joint against decoupled estimation, in batch and online."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from benchmarks import joint as module
from benchmarks.joint import batch_run, joint_rows, online_run
from data_tools.simulator import simulate_scene
from pipelines.config import load_config
from pipelines.slam.joint import run_joint, street
from saga_fg import InputError
from saga_fg.slam.joint import JointSettings

SHORT = replace(street(), duration=2.0)
CONFIG = load_config("simulated")


def test_recordings_are_pooled_and_the_same_odometry_is_compared() -> None:
    scenes = [simulate_scene(SHORT, seed, f"street {seed}") for seed in (1, 2)]
    settings = JointSettings(passes=1)
    rows = list(joint_rows(scenes, [0], partial(batch_run, config=CONFIG, settings=settings, poles=True)))
    paths = [row for title, row in rows if "path, m" in row]
    assert [row["recording"] for row in paths] == ["street 1", "street 2"]
    for scene, row in zip(scenes, paths, strict=True):
        errors = run_joint(scene, CONFIG, settings, "lidar", 0).errors()
        assert (row["ATE, m: decoupled"], row["joint"]) == (errors["odometry"].ate, errors["joint"].ate)
        assert np.isfinite(row["ATE with poles"])
    change = next(row["change"] for _, row in rows if row.get("error") == "joint against decoupled")
    squares = np.square([(row["joint"], row["ATE, m: decoupled"]) for row in paths]).sum(axis=0)
    assert change.estimate == pytest.approx(np.sqrt(squares[0] / squares[1]) - 1)


def test_online_objects_are_scored_where_both_report_them() -> None:
    scenes = [simulate_scene(replace(SHORT, duration=3.0), seed, f"street {seed}") for seed in (1, 2)]
    rows = list(joint_rows(scenes, [0], partial(online_run, config=CONFIG, settings=JointSettings(), lag=1.0)))
    paths = [row for title, row in rows if title == "error of the vehicle's path"]
    for scene, row in zip(scenes, paths, strict=True):
        errors = run_joint(scene, CONFIG, JointSettings(), "lidar", 0, lag=1.0).errors()
        assert (row["ATE, m: decoupled"], row["ATE, m: joint"]) == (errors["odometry"].ate, errors["online"].ate)
    objects = [row for title, row in rows if title.startswith("RMSE")]
    assert {row["method"] for row in objects} == {"decoupled", "joint"}
    for row in objects:
        assert row["pairs"] > 5
        assert 0 < row["world velocity, m/s"] < 5
        assert 0 < row["ego position, m"] < 1
    squares = {
        name: sum(row["pairs"] * row["world position, m"] ** 2 for row in objects if row["method"] == name)
        for name in ("decoupled", "joint")
    }
    change = next(row for _, row in rows if row.get("objects") == "moving")
    expected = np.sqrt(squares["joint"] / squares["decoupled"]) - 1
    assert change["world position, m"].estimate == pytest.approx(expected)
    with pytest.raises(InputError, match="expected ground truth"):
        online_run(replace(scenes[0], ground_truth=None), 0, CONFIG, JointSettings(), 1.0)


def test_options_go_together(refused) -> None:
    assert "expected both --dataroot and --detections" in refused("joint --dataroot somewhere")
    assert "--online: expected without --poles" in refused("joint --online --poles")


def test_the_command_prints_the_changes(bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "street", lambda parked: SHORT)
    compared = {row.get("compared") for row in bench("joint --scenes 2")}
    assert {"joint against decoupled", "joint against held"} <= compared

"""Our nuScenes tracking metrics against the official ones, run by an interpreter of their own.

The official development kit needs NumPy 1, so it lives in another environment: SAGA_FG_DEVKIT_PYTHON names its python.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
from collections.abc import Sequence
from dataclasses import fields
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nuscenes_random_drive import VERSION, write_random_drive

from data_tools.metrics import NuScenesTrackingMetrics, TrackingFigures, nuscenes_tracking_metrics
from data_tools.nuscenes import NuScenes, ResultMeta, split_scenes, write_tracking_results
from data_tools.nuscenes.scored_scenes import read_scored_scenes
from saga_fg import Annotations, Boxes, Tracks


@pytest.fixture(scope="session")
def devkit() -> str:
    python = os.environ.get("SAGA_FG_DEVKIT_PYTHON", "")
    if not python:
        pytest.skip("no official development kit: set SAGA_FG_DEVKIT_PYTHON to a python that has nuscenes-devkit")
    return python


def official(python: str, result: Path, dataroot: Path, split: str) -> dict[str, Any]:
    script = Path(__file__).with_name("nuscenes_devkit_figures.py")
    run = subprocess.run(
        [python, str(script), str(result), str(dataroot), VERSION, split], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr[-2000:]
    return dict(json.loads(run.stdout))


def assert_equal(ours: NuScenesTrackingMetrics, theirs: dict[str, Any]) -> None:
    for field in fields(TrackingFigures):
        if field.name != "gt":  # over all classes the official figure is a mean, ours a sum
            assert getattr(ours.overall, field.name) == pytest.approx(theirs[field.name], abs=1e-6), field.name
        for label, value in theirs["label_metrics"][field.name].items():
            got = getattr(ours.per_class[label], field.name)
            assert got == pytest.approx(value, abs=1e-6, nan_ok=True), (label, field.name)


@pytest.mark.parametrize("seed", [0, 1])
def test_random_drives(devkit: str, tmp_path: Path, seed: int) -> None:
    result = write_random_drive(tmp_path / "drive", seed)
    ours = nuscenes_tracking_metrics(list(read_scored_scenes(result, tmp_path / "drive", VERSION).values()))
    assert ours.overall.ids > 0
    assert math.isnan(ours.per_class["trailer"].amota)
    assert_equal(ours, official(devkit, result, tmp_path / "drive", "drive"))


def test_a_recording(devkit: str, recordings: Path, tmp_path: Path) -> None:
    root = recordings / "nuscenes"
    names = split_scenes(root, VERSION, "camera")
    dataset = NuScenes(root, VERSION, {}, names, ground_truth=True)
    rng = np.random.default_rng(0)
    scenes = [dataset.scene(name) for name in names]
    tracked = [(scene, noisy_tracks(scene.ground_truth or [], rng)) for scene in scenes]
    write_tracking_results(tmp_path / "result.json", tracked, ResultMeta(use_lidar=True))
    ours = nuscenes_tracking_metrics(list(read_scored_scenes(tmp_path / "result.json", root, VERSION, names).values()))
    assert ours.overall.ids > 0
    assert_equal(ours, official(devkit, tmp_path / "result.json", root, "camera"))


def noisy_tracks(truth: Sequence[Annotations], rng: np.random.Generator) -> list[Tracks]:
    """The truth, shaken, a quarter of it missing, tracks broken now and then."""
    numbers: dict[str, int] = {}
    fresh = count()
    moments = []
    for k, moment in enumerate(truth):
        rows = np.flatnonzero(rng.random(len(moment)) < 0.75)
        names = moment.id[rows].tolist()
        for name in names:
            if name not in numbers or rng.random() < 0.05:
                numbers[name] = next(fresh)
        boxes, n = moment.boxes.select(rows), len(rows)
        position = boxes.position + rng.normal(0, 0.4, (n, 3))
        identity = np.array([numbers[name] for name in names], dtype=np.int64)
        unknown = np.tile(np.eye(2), (n, 1, 1))
        shaken = Boxes(boxes.label, position, boxes.size, boxes.yaw, boxes.velocity)
        moments.append(Tracks(0.5 * k, identity, shaken, rng.random(n).round(1), unknown, unknown, np.zeros(n)))
    return moments

"""Our nuScenes tracking metrics against the official ones, run by an interpreter of their own.

The official development kit needs NumPy 1, so it lives in another environment: SAGA_FG_DEVKIT_PYTHON names its python.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Sequence
from dataclasses import fields
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.metrics import PYTHON_VARIABLE, differences, official_figures, parity, tracked_simulation
from data_tools.datasets.nuscenes import NuScenes, ResultMeta, split_scenes, write_tracking_results
from data_tools.datasets.nuscenes.source import read_scored_scenes
from data_tools.metrics import NuScenesClassMetrics, NuScenesTrackingMetrics, nuscenes_tracking_metrics
from saga_fg import Annotations, Boxes, InputError, Tracks
from tests.data_tools.nuscenes_random_drive import VERSION, write_random_drive


@pytest.fixture(scope="session")
def devkit() -> str:
    python = os.environ.get(PYTHON_VARIABLE, "")
    if not python:
        pytest.skip(f"no official development kit: set {PYTHON_VARIABLE} to a python that has nuscenes-devkit")
    return python


def assert_equal(ours: NuScenesTrackingMetrics, theirs: dict[str, Any]) -> None:
    apart = {name: value for name, value in differences(ours, theirs) if value > 1e-6}
    assert not apart


def test_a_random_drive(devkit: str, tmp_path: Path) -> None:
    result = write_random_drive(tmp_path / "drive", seed=0)
    ours = nuscenes_tracking_metrics(
        [each.tracking for each in read_scored_scenes(result, tmp_path / "drive", VERSION).values()]
    )
    assert ours.overall.ids > 0
    assert math.isnan(ours.per_class["trailer"].amota)
    assert_equal(ours, official_figures(devkit, result, tmp_path / "drive", VERSION, "drive")[0])


def test_a_simulated_scene(devkit: str, tmp_path: Path) -> None:
    result = tracked_simulation(tmp_path / "simulated", scenes=1)
    outcome = parity(devkit, result, tmp_path / "simulated", VERSION, "all")
    assert outcome["AMOTA"] > 0.3
    assert outcome["largest difference"] <= 1e-6, outcome["where"]


def test_a_difference_is_found() -> None:
    ours = NuScenesTrackingMetrics(NuScenesClassMetrics(*np.arange(17.0)), per_class={}, curves={})
    names = [field.name for field in fields(NuScenesClassMetrics)]
    theirs = dict(zip(names, np.arange(17.0), strict=True)) | {"label_metrics": {name: {} for name in names}}
    assert max(value for _, value in differences(ours, theirs)) == 0
    assert dict(differences(ours, theirs | {"ids": 12.5}))["ids"] == 0.5
    assert dict(differences(ours, theirs | {"lgd": math.nan}))["lgd"] == math.inf


def test_a_kit_that_fails_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a python that has nuscenes-devkit"):
        official_figures(str(tmp_path / "python"), tmp_path, tmp_path, VERSION, "all")
    with pytest.raises(InputError, match=r"the development kit failed: .*Error"):
        official_figures(sys.executable, tmp_path, tmp_path, VERSION, "all")


def test_a_recording(devkit: str, recordings: Path, tmp_path: Path) -> None:
    root = recordings / "nuscenes"
    names = split_scenes(root, VERSION, "camera")
    dataset = NuScenes(root, VERSION, {}, names, ground_truth=True)
    rng = np.random.default_rng(0)
    scenes = [dataset.scene(name) for name in names]
    tracked = [(scene, noisy_tracks(scene.ground_truth or [], rng)) for scene in scenes]
    write_tracking_results(tmp_path / "result.json", tracked, ResultMeta(use_lidar=True))
    ours = nuscenes_tracking_metrics(
        [each.tracking for each in read_scored_scenes(tmp_path / "result.json", root, VERSION, names).values()]
    )
    assert ours.overall.ids > 0
    assert_equal(ours, official_figures(devkit, tmp_path / "result.json", root, VERSION, "camera")[0])


def noisy_tracks(truth: Sequence[Annotations], rng: np.random.Generator) -> list[Tracks]:
    """The truth, shaken, a quarter of it missing, tracks broken now and then."""
    numbers: dict[str, int] = {}
    fresh = count()
    frames = []
    for k, frame in enumerate(truth):
        rows = np.flatnonzero(rng.random(len(frame)) < 0.75)
        names = frame.id[rows].tolist()
        for name in names:
            if name not in numbers or rng.random() < 0.05:
                numbers[name] = next(fresh)
        boxes, n = frame.boxes.select(rows), len(rows)
        position = boxes.position + rng.normal(0, 0.4, (n, 3))
        identity = np.array([numbers[name] for name in names], dtype=np.int64)
        unknown = np.tile(np.eye(2), (n, 1, 1))
        shaken = Boxes(boxes.label, position, boxes.size, boxes.yaw, boxes.velocity)
        frames.append(Tracks(0.5 * k, identity, shaken, rng.random(n).round(1), unknown, unknown, np.zeros(n)))
    return frames

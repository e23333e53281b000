"""The benchmark of the smoother on hidden objects: detections are given to their true objects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import smoothing
from benchmarks.smoothing import true_objects
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from pipelines.smoothing import load_smooth_config, smooth_known_objects
from saga_fg.smoothing import gather_evidence


def test_detections_find_their_true_objects() -> None:
    scene = SimulatedTraffic(replace(SimulatorSettings(), duration=3.0), scenes=1, seed=4).scene("scene-0001")
    config = load_smooth_config("simulated")
    evidence = gather_evidence(scene.frames, scene.timestamps, config.sensors, config.tracking.tracker.classes)
    assert scene.ground_truth is not None
    names = sorted({str(name) for truth in scene.ground_truth for name in truth.id.tolist()})
    object_of = true_objects(scene, evidence, names)
    assert (object_of >= 0).mean() > 0.7  # the rest is clutter
    states = smooth_known_objects(evidence, object_of, config.smoothing, config.tracking.of_method("kf").tracker)
    assert set(np.unique(states.id).tolist()) == set(np.unique(object_of[object_of >= 0]).tolist())
    last = scene.ground_truth[-1]
    k = int(np.searchsorted(evidence.times, scene.timestamps[-1]))
    ids = np.array([names.index(str(name)) for name in last.id[last.visible].tolist()])
    at = states.rows_of(np.full(len(ids), k), ids)
    error = states.mean[at, :2] + evidence.origin - last.boxes.position[last.visible, :2]
    assert np.median(np.hypot(*error[at >= 0].T)) < 0.15


def test_the_benchmark_compares_the_same_boxes(bench, monkeypatch: pytest.MonkeyPatch) -> None:
    short = replace(SimulatorSettings(), duration=4.0)
    monkeypatch.setattr(smoothing, "SimulatedTraffic", lambda scenes, seed: SimulatedTraffic(short, scenes, seed))
    (row,) = bench("smoothing --scenes 2")
    assert row["boxes"] > 10
    assert row["relative change"]["estimate"] == pytest.approx(row["with edges"] / row["without"] - 1)

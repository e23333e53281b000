"""The benchmark of the smoother: covariances against errors, and hidden objects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.drawn_recordings import drawn_fit
from benchmarks.hidden_objects import true_objects
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from pipelines.smoothing import load_smooth_config, smooth_known_objects
from saga_fg.smoothing import gather_evidence


def test_errors_are_as_large_as_the_covariances_say() -> None:
    fit = drawn_fit(samples=1000, seed=0)  # 2000 components: the ratio's standard deviation is 1.6 %
    assert fit.samples == 1000
    assert fit.ratio == pytest.approx(1.0, abs=0.05)


def test_what_is_drawn_follows_from_the_seed() -> None:
    fits = [drawn_fit(samples=50, seed=seed) for seed in (1, 1)]
    assert fits[0] == fits[1]  # drawn anew from the same seed
    assert fits[0].measured != drawn_fit(samples=50, seed=2).measured


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

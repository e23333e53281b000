"""The smoother with and without edges, on hidden objects in simulated traffic.

Detections are given to their true objects, so that nothing but the smoother differs. Its states of objects that no
sensor sees, between one detection and the next, are compared with the truth, at the same moments of the same objects.
The simulator does not drive by the smoother's dynamics, and both have the same process noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
import typer

from benchmarks.bootstrap import paired_bootstrap
from benchmarks.runner import Rows, Seed, each
from data_tools.simulator import SimulatedTraffic
from pipelines.cli.options import Config
from pipelines.smoothing import load_smooth_config
from pipelines.tracking import one_thread
from saga_fg.numerics import FloatArray, IntArray
from saga_fg.smoothing import (
    Evidence,
    SmoothingSettings,
    StateTable,
    StationaryStates,
    assign_detections,
    gather_evidence,
    smooth_states,
)
from saga_fg.smoothing.passes import Passes
from saga_fg.tracking import TrackerSettings
from saga_fg.types import Scene

NEAR = 2.0  # largest distance between a detection and its true object, m
SPREAD = 0.3  # of a detection about its true object, besides the sensor's noise, m


def smoothing(
    scenes: Annotated[int, typer.Option("--scenes", min=2, help="Simulated scenes.")] = 10,
    seed: Seed = 0,
    config: Config = None,
) -> Rows:
    """The smoother with and without edges on hidden objects; which detection is of which object is known.

    \b
    Example:
      python -m benchmarks smoothing --scenes 4 --seed 100 --json figures.json
    """
    settings, sums = load_smooth_config("simulated", config), dict[str, list[tuple[float, int]]](saga=[], kf=[])
    for number in each(range(seed, seed + scenes), "smoothing"):
        scene = SimulatedTraffic(scenes=1, seed=number).scene("scene-0001")
        evidence = gather_evidence(scene.frames, scene.timestamps, settings.sensors, settings.tracking.tracker.classes)
        names = sorted({str(name) for truth in scene.ground_truth or () for name in truth.id.tolist()})
        object_of = true_objects(scene, evidence, names)
        for method in ("saga", "kf"):
            tracker = settings.tracking.of_method(method).tracker
            with one_thread():
                states = smooth_known_objects(evidence, object_of, settings.smoothing, tracker)
            error = _hidden_errors(scene, evidence, states, names)
            sums[method].append((float(np.sum(error**2)), len(error)))
    (square, boxes), (alone, _) = (np.sum(sums[method], axis=0) for method in ("saga", "kf"))
    change = paired_bootstrap(sums["saga"], sums["kf"])
    row = {"boxes": int(boxes), "with edges": np.sqrt(square / boxes), "without": np.sqrt(alone / boxes)}
    yield "RMSE of hidden objects, m", {**row, "relative change": change}


def true_objects(scene: Scene, evidence: Evidence, names: Sequence[str]) -> IntArray:
    """(N,) the number among `names` of the object that each detection is of, -1 for clutter."""
    assert scene.ground_truth is not None
    number = {name: k for k, name in enumerate(names)}
    object_of = np.full(len(evidence), -1, dtype=np.int64)
    for frame, rows in zip(evidence.frames, evidence.rows_of_frame(), strict=True):
        time = evidence.times[frame.moment]
        k = int(np.argmin(np.abs(scene.timestamps - time)))
        truth = scene.ground_truth[k]
        moved = truth.boxes.position[:, :2] + truth.boxes.velocity * (time - scene.timestamps[k])
        objects, detections = assign_detections(
            truth.boxes.label,
            moved - evidence.origin,
            np.tile(SPREAD**2 * np.eye(2), (len(truth), 1, 1)),
            evidence,
            np.arange(rows.start, rows.stop),
            0.999,
            np.full(len(truth), NEAR),
        )
        object_of[detections] = [number[str(truth.id[row])] for row in objects]
    return object_of


def _hidden_errors(scene: Scene, evidence: Evidence, states: StateTable, names: Sequence[str]) -> FloatArray:
    """Distances, m, of the states of hidden objects from the truth."""
    assert scene.ground_truth is not None
    number, errors = {name: k for k, name in enumerate(names)}, [np.empty(0)]
    for time, truth in zip(scene.timestamps.tolist(), scene.ground_truth, strict=True):
        hidden = np.flatnonzero(~truth.visible)
        ids = np.array([number[str(truth.id[row])] for row in hidden], dtype=np.int64)
        at = states.rows_of(np.full(len(ids), np.searchsorted(evidence.times, time)), ids)
        offset = states.mean[at, :2] + evidence.origin - truth.boxes.position[hidden, :2]
        errors.append(np.hypot(*offset[at >= 0].T))
    return np.concatenate(errors)


def smooth_known_objects(
    evidence: Evidence, object_of: IntArray, settings: SmoothingSettings, tracker: TrackerSettings
) -> StateTable:
    """States by the last pass alone, without stationary states; object_of (N,): true object of each detection, -1 for
    none."""
    passes = Passes(evidence, settings, tracker, ())
    lifespans = evidence.lifespans(object_of)
    states = smooth_states(evidence, object_of, lifespans, passes.motion(lifespans))
    return passes.final(lifespans, object_of, states, StationaryStates(settings.position_drift))

"""`python -m benchmarks smoothing`: the smoother with and without edges, on hidden objects in simulated traffic.

Detections are given to their true objects, so that nothing but the smoother differs. Its states of objects that no
sensor sees, between one detection and the next, are compared with the truth, at the same moments of the same objects.
The simulator does not drive by the smoother's dynamics, and both have the same process noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import typer

from data_tools.figures import FigureTable, cell, percent
from data_tools.metrics import Interval, paired_bootstrap
from data_tools.simulator import SimulatedTraffic
from pipelines.cli.console import progress_bar
from pipelines.cli.options import Config, Verbose
from pipelines.cli.tables import JsonFile, report
from pipelines.process import one_thread
from pipelines.smoothing import SmoothConfig, load_smooth_config, smooth_known_objects
from pipelines.tracking import Progress
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.smoothing import Evidence, StateTable, assign_detections, gather_evidence
from saga_fg.types.dataset import Scene

NEAR = 2.0  # largest distance between a detection and its true object, m
SPREAD = 0.3  # of a detection about its true object, besides the sensor's noise, m


@dataclass(frozen=True)
class HiddenFigures:
    """Root mean square errors of hidden objects with and without edges, m, over `boxes`, and the relative change."""

    seeds: tuple[int, ...]
    boxes: int
    with_edges: float
    without_edges: float
    change: Interval


def hidden_objects(config: SmoothConfig, seeds: Sequence[int], progress: Progress | None = None) -> HiddenFigures:
    """Smooth simulated scenes, one of each seed, with and without edges."""
    sums: dict[bool, list[tuple[float, float]]] = {True: [], False: []}
    for count, seed in enumerate(seeds):
        scene = SimulatedTraffic(scenes=1, seed=seed).scene("scene-0001")
        evidence = gather_evidence(scene.frames, scene.timestamps, config.sensors, config.tracking.tracker.classes)
        names = sorted({str(name) for truth in scene.ground_truth or () for name in truth.id.tolist()})
        object_of = true_objects(scene, evidence, names)
        for edges in (True, False):
            tracker = config.tracking.of_method("saga" if edges else "kf").tracker
            with one_thread():
                states = smooth_known_objects(evidence, object_of, config.smoothing, tracker)
            error = _hidden_errors(scene, evidence, states, names)
            sums[edges].append((float(np.sum(error**2)), float(len(error))))
        if progress is not None:
            progress("smoothing", count + 1, len(seeds))
    (square, boxes), (square_without, _) = (np.sum(sums[edges], axis=0) for edges in (True, False))
    change = paired_bootstrap(sums[True], sums[False])
    return HiddenFigures(
        tuple(seeds), int(boxes), float(np.sqrt(square / boxes)), float(np.sqrt(square_without / boxes)), change
    )


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
        P = np.tile(SPREAD**2 * np.eye(2), (len(truth), 1, 1))
        objects, detections = assign_detections(
            truth.boxes.label,
            moved - evidence.origin,
            P,
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
    number = {name: k for k, name in enumerate(names)}
    errors = [np.empty(0)]
    for time, truth in zip(scene.timestamps.tolist(), scene.ground_truth, strict=True):
        hidden = np.flatnonzero(~truth.visible)
        ids = np.array([number[str(truth.id[row])] for row in hidden], dtype=np.int64)
        moment = np.full(len(ids), np.searchsorted(evidence.times, time))
        at = states.rows_of(moment, ids)
        offset = states.mean[at, :2] + evidence.origin - truth.boxes.position[hidden, :2]
        errors.append(np.hypot(*offset[at >= 0].T))
    return np.concatenate(errors)


def smoothing(
    scenes: Annotated[int, typer.Option("--scenes", min=2, help="Simulated scenes.")] = 10,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the first of them.")] = 0,
    json_file: JsonFile = None,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """The smoother with and without edges on hidden objects; which detection is of which object is known.

    \b
    Example:
      python -m benchmarks smoothing --scenes 4 --seed 100 --json figures.json
    """
    with progress_bar(unit="scenes") as progress:
        figures = hidden_objects(load_smooth_config("simulated", config), range(seed, seed + scenes), progress)
    row = (str(figures.boxes), cell(figures.with_edges), cell(figures.without_edges), percent(figures.change))
    columns = ("boxes", "with edges", "without", "change, 95 % interval")
    report([FigureTable(f"{scenes} simulated scenes; RMSE of hidden objects, m", columns, (row,))], figures, json_file)

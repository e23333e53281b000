"""Does the incremental smoother settle at the minimum of nonlinear graphs, and say so?

Scenes are sampled from the model itself (`benchmarks.sampled_traffic`): a vehicle drives by odometry and sees, in
range and bearing, cars that follow each other (intelligent driver) and pedestrians who keep apart (social force). In
others two pedestrians 2 m apart walk into each other and come closer than 0.5 m, either as the law says or, against it,
straight on. Nothing is marginalised. After each frame every variable of `IncrementalSmoother` is compared with that of
`BatchSolver`, Levenberg-Marquardt on the whole graph, in standard deviations of the latter.

A frame is silent where the smoother says that it has settled and is farther off than `SILENT`. The batch solver then
starts from there: where it stays, the smoother is at another minimum of the same graph.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import gtsam
import numpy as np
import typer

from benchmarks.runner import Rows, Seed, each
from benchmarks.sampled_traffic import (
    INITIAL_STATE_COVARIANCE,
    RANGE_BEARING_COVARIANCE,
    SampledFrame,
    SampledTraffic,
    States,
    process_noise,
    providers,
    sample_traffic,
)
from pipelines.tracking import one_thread
from saga_fg.estimators import BatchSolver, IncrementalSmoother
from saga_fg.numerics import FloatArray

TITLE = "the incremental smoother against Levenberg-Marquardt on the whole graph"
MIXED, EVADING, STRAIGHT = "mixed", "crossing, evading", "crossing, straight on"
SILENT = 1e-3  # standard deviations
NEAR = 0.5  # m, that two who cross come to each other at least
APART = 2.0  # m, at the start
INTERVAL = 0.2  # s, of crossings


@dataclass(frozen=True)
class _Frame:
    settled: bool
    batch_settled: bool
    difference: float
    other_minimum: bool


def settling(
    mixed: Annotated[int, typer.Option("--mixed", min=0, help="Scenes of cars and pedestrians.")] = 150,
    crossings: Annotated[
        int, typer.Option("--crossings", min=0, help="Scenes of two pedestrians who walk into each other.")
    ] = 50,
    frames: Annotated[int, typer.Option("--frames", min=8, help="Length of a scene.")] = 12,
    seed: Seed = 0,
) -> Rows:
    """Whether the incremental smoother settles at the minimum that Levenberg-Marquardt finds on the whole graph.

    \b
    Examples:
      python -m benchmarks settling
      python -m benchmarks settling --mixed 10 --crossings 10 --json figures.json
    """
    evading = crossings // 2
    wanted = {MIXED: mixed, EVADING: evading, STRAIGHT: crossings - evading}
    with one_thread():
        for place, (kind, scenes) in enumerate(wanted.items()):
            found: list[_Frame] = []
            for number in each(range(scenes), kind):
                found += _compared(sample_scene(kind, np.random.default_rng([seed, place, number]), frames))
            if found:
                yield TITLE, {"scenes": kind, "number": scenes, **_figures(found)}


def sample_scene(kind: str, rng: np.random.Generator, frames: int) -> SampledTraffic:
    """A scene of a kind."""
    if kind == MIXED:
        return sample_traffic(rng, frames, cars=int(rng.integers(1, 5)), pedestrians=int(rng.integers(0, 4)))
    while True:
        scene = _crossing(rng, frames, evades=kind == EVADING)
        if min(np.hypot(*(one.states[0] - one.states[1])[:2]) for one in scene.frames) < NEAR:
            return scene


def _crossing(rng: np.random.Generator, frames: int, evades: bool) -> SampledTraffic:
    """Two pedestrians walk into each other, some metres before a vehicle that stands still."""
    scene = SampledTraffic(gtsam.Pose2(), {0: "pedestrian", 1: "pedestrian"})
    still, angle = gtsam.Pose2(), rng.uniform(0, 2 * np.pi)
    u, centre = np.array([np.cos(angle), np.sin(angle)]), np.array([rng.uniform(6, 12), rng.uniform(-3, 3)])
    aside = rng.uniform(-NEAR, NEAR) / 2 * np.array([-u[1], u[0]])
    states: States = {}
    for node, sign in ((0, 1.0), (1, -1.0)):
        place = centre - sign * (APART / 2 * u + aside)
        states[node] = np.concatenate([place, sign * rng.uniform(0.8, 1.5) * u])
    sampled = np.linalg.cholesky(INITIAL_STATE_COVARIANCE)
    new = {node: x + sampled @ rng.normal(size=4) for node, x in states.items()}
    for k in range(frames):
        if k:
            states = {node: _moved(scene, node, states, evades, rng) for node in states}
        seen = {node: _seen(x, rng) for node, x in states.items() if rng.random() < 0.8}
        dt = INTERVAL if k else 0.0
        scene.frames.append(SampledFrame(k * INTERVAL, dt, still, still, states, {} if k else new, seen))
    return scene


def _moved(scene: SampledTraffic, node: int, states: States, evades: bool, rng: np.random.Generator) -> FloatArray:
    others = [states[1 - node]] if evades else []
    moved = np.asarray(scene.interaction(node, [1 - node]).predict(states[node], others, INTERVAL))
    return moved + np.linalg.cholesky(process_noise(INTERVAL)) @ rng.normal(size=4)


def _seen(x: FloatArray, rng: np.random.Generator) -> FloatArray:
    z = np.array([np.hypot(x[0], x[1]), np.arctan2(x[1], x[0])])
    return z + np.linalg.cholesky(RANGE_BEARING_COVARIANCE) @ rng.normal(size=2)


def _compared(scene: SampledTraffic) -> list[_Frame]:
    smoother, batch = IncrementalSmoother(providers(scene), None), BatchSolver(providers(scene))
    found = []
    for frame in scene.frames:
        smoother.step(frame.time)
        batch.step(frame.time)
        settled, batch_settled = smoother.solution().converged, batch.solve().converged
        difference, other = largest_difference(smoother, batch), False
        if settled and batch_settled and difference > SILENT:
            other = largest_difference(smoother, BatchSolver(graph=smoother.snapshot())) <= SILENT
        found.append(_Frame(settled, batch_settled, difference, other))
    return found


def largest_difference(smoother: IncrementalSmoother, batch: BatchSolver) -> float:
    """Largest of a component of all variables, in the batch solver's standard deviations."""
    largest = 0.0
    for key, variable in batch.graph().variables.items():
        apart = variable.type.local(batch.state(key), smoother.state(key))
        largest = max(largest, float((np.abs(apart) / np.sqrt(np.diag(batch.covariance(key)))).max()))
    return largest


def _figures(found: Sequence[_Frame]) -> dict[str, float]:
    """Of frames that have settled by both: the largest difference, and how many are farther off than `SILENT`."""
    judged = [one for one in found if one.settled and one.batch_settled]
    silent = [one for one in judged if one.difference > SILENT]
    return {
        "frames": len(found),
        "settled, %": 100 * sum(one.settled for one in found) / len(found),
        "off by, sigma": max((one.difference for one in judged), default=math.nan),
        "silent": len(silent),
        "at another minimum": sum(one.other_minimum for one in silent),
        "LM unsettled": sum(not one.batch_settled for one in found),
    }

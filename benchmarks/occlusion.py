"""`python -m benchmarks occlusion`: `saga` against `kf` on hidden objects in simulated traffic.

The process noise of both is fitted by likelihood, class by class, on scenes of other seeds; they differ in the edges
alone. The error is the distance of a hidden object from the track that followed it when it was last seen; a lost object
counts with a cap (`data_tools.metrics.scene`). An object is *occluded* while it is hidden between two views; one that
is never seen again has left, and counts only among the *hidden*. Intervals are paired bootstraps over scenes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import typer

from data_tools.figures import FigureTable, cell, percent
from data_tools.metrics import Interval, SceneMetrics, paired_bootstrap, scene_metrics
from data_tools.simulator import SimulatorSettings, simulate_scene
from pipelines.cli.console import progress_bar
from pipelines.cli.options import Config, Verbose
from pipelines.cli.tables import JsonFile, report
from pipelines.config import Method, TrackConfig, load_config
from pipelines.tracking import Progress, track_scene
from saga_fg.errors import InputError
from saga_fg.learning import fit_acceleration_noise_by_class, measured_trajectories
from saga_fg.types.dataset import Annotations, Scene

METHODS: tuple[Method, Method] = ("kf", "saga")


@dataclass(frozen=True, eq=False)
class OcclusionResult:
    """Pooled metrics of each method over occluded and over all hidden objects, and what saga changes in their RMSE.

    occluded, hidden  metrics by method; *_change: RMSE of saga over that of kf, less 1; acceleration_noise: by class
    """

    occluded: dict[Method, SceneMetrics]
    occluded_change: Interval
    hidden: dict[Method, SceneMetrics]
    hidden_change: Interval
    acceleration_noise: dict[str, float]
    seeds: tuple[int, ...]
    fit_seeds: tuple[int, ...]


def bench_occlusion(
    config: TrackConfig,
    seeds: Sequence[int],
    fit_seeds: Sequence[int],
    progress: Progress | None = None,
) -> OcclusionResult:
    """Fit on `fit_seeds`, compare on `seeds`."""
    simulator = SimulatorSettings()
    total = len(fit_seeds) + len(seeds)

    def scenes() -> Iterator[Scene]:
        for done, seed in enumerate(fit_seeds):
            yield simulate_scene(simulator, seed)
            if progress is not None:
                progress("fitting", done + 1, total)

    noise = fit_acceleration_noise_by_class(measured_trajectories(scenes(), config.sensors))
    config = config.with_acceleration_noise(noise)
    occluded: dict[Method, list[SceneMetrics]] = {method: [] for method in METHODS}
    hidden: dict[Method, list[SceneMetrics]] = {method: [] for method in METHODS}
    for done, seed in enumerate(seeds):
        scene = simulate_scene(simulator, seed)
        assert scene.ground_truth is not None
        returning = until_last_seen(scene.ground_truth)
        for method in METHODS:
            tracks = track_scene(scene, config.new_tracker(method)).tracks
            occluded[method].append(scene_metrics(returning, tracks))
            hidden[method].append(scene_metrics(scene.ground_truth, tracks))
        if progress is not None:
            progress("tracking", len(fit_seeds) + done + 1, total)
    return OcclusionResult(
        *_pooled(occluded), *_pooled(hidden), acceleration_noise=noise, seeds=tuple(seeds), fit_seeds=tuple(fit_seeds)
    )


def until_last_seen(moments: Sequence[Annotations]) -> tuple[Annotations, ...]:
    """Ground truth without the objects that stay hidden from there on: what is left hidden will be seen again."""
    last: dict[str, int] = {}
    for k, truth in enumerate(moments):
        last.update(dict.fromkeys(truth.id[truth.visible].tolist(), k))
    kept = []
    for k, truth in enumerate(moments):
        rows = np.array([last.get(name, -1) >= k for name in truth.id.tolist()], dtype=np.bool_)
        kept.append(Annotations(truth.id[rows], truth.boxes.select(rows), truth.visible[rows]))
    return tuple(kept)


def _pooled(metrics: dict[Method, list[SceneMetrics]]) -> tuple[dict[Method, SceneMetrics], Interval]:
    kf, saga = ([m.carried.square_sums for m in metrics[method]] for method in METHODS)
    return {method: SceneMetrics.pool(metrics[method]) for method in METHODS}, paired_bootstrap(saga, kf)


def occlusion(
    scenes: Annotated[int, typer.Option("--scenes", min=2, help="Simulated scenes to compare on.")] = 10,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the first of them.")] = 0,
    fit_scenes: Annotated[int, typer.Option("--fit-scenes", min=1, help="Scenes the process noise is fitted on.")] = 6,
    fit_seed: Annotated[int, typer.Option("--fit-seed", min=0, help="Seed of the first of those.")] = 1000,
    json_file: JsonFile = None,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """What the graph is worth where objects are hidden, on simulated traffic.

    \b
    Examples:
      python -m benchmarks occlusion
      python -m benchmarks occlusion --scenes 20 --seed 100 --json figures.json
    """
    fit_seeds, seeds = range(fit_seed, fit_seed + fit_scenes), range(seed, seed + scenes)
    if set(fit_seeds) & set(seeds):
        raise InputError(f"--fit-seed {fit_seed}: expected other scenes to fit on than to compare on")
    with progress_bar() as progress:
        result = bench_occlusion(load_config("simulated", config), seeds, fit_seeds, progress)
    rows = []
    for method, m in result.hidden.items():
        errors = (m.carried.rmse, result.occluded[method].carried.rmse, m.position.rmse, m.carried.median, m.mota)
        rows.append((method, *(cell(x) for x in errors), str(m.switches)))
    changes = (percent(result.hidden_change), percent(result.occluded_change))
    rows.append(("saga / kf - 1, 95 % interval", *changes, "", "", "", ""))
    noise = ", ".join(f"{label} {q:.3g}" for label, q in result.acceleration_noise.items())
    title = f"{scenes} simulated scenes; RMSE, m; acceleration noise fitted on {fit_scenes} others, m^2/s^3: {noise}"
    columns = ("method", "hidden", "occluded", "in view", "hidden: median", "MOTA", "ID switches")
    figures = {
        "seeds": result.seeds,
        "fit_seeds": result.fit_seeds,
        "acceleration_noise": result.acceleration_noise,
        "occluded_rmse": {method: m.carried.rmse for method, m in result.occluded.items()},
        "occluded_change": result.occluded_change,
        "hidden_rmse": {method: m.carried.rmse for method, m in result.hidden.items()},
        "hidden_change": result.hidden_change,
    }
    report([FigureTable(title, columns, tuple(rows))], figures, json_file)

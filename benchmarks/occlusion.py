"""What the graph is worth where objects hide: `saga` against `kf` on simulated traffic.

The process noise of both is fitted by likelihood, class by class, on scenes of other seeds than those they are compared
on; they differ in nothing but the edges. The error is that of hidden objects, by the track that followed each when it
was last seen, lost ones counted at a cap (`data_tools.metrics.scene`). An object is *occluded* while it is hidden
between two views; one that is never seen again has left, and counts only among the *hidden*. Intervals are paired
bootstraps over scenes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from data_tools.metrics import Interval, SceneMetrics, paired_bootstrap, scene_metrics
from data_tools.simulator import SimulatorSettings, simulate_scene
from pipelines.config import Method, TrackConfig
from pipelines.tracking import Progress, track_scene
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


def occlusion(
    config: TrackConfig,
    seeds: Sequence[int],
    fit_seeds: Sequence[int],
    simulator: SimulatorSettings | None = None,
    progress: Progress | None = None,
) -> OcclusionResult:
    """Fit on `fit_seeds`, compare on `seeds`."""
    simulator = simulator or SimulatorSettings()
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

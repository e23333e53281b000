"""Comparison of several methods on the same scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from data_tools.figures import FigureTable, cell
from data_tools.metrics import SceneMetrics, SceneMetricSettings, scene_metrics
from pipelines.config import Method, TrackConfig
from pipelines.tracking import Progress, TrackedScene, track_scene
from saga_fg.errors import InputError
from saga_fg.types.dataset import Dataset


@dataclass(frozen=True, eq=False)
class Comparison:
    """Runs of each method over the same scenes, and their metrics pooled over the scenes."""

    runs: dict[Method, tuple[TrackedScene, ...]]
    metrics: dict[Method, SceneMetrics]

    def milliseconds_per_frame(self, method: Method) -> float:
        """Mean time the tracker took for one frame."""
        runs = self.runs[method]
        return 1000 * sum(run.seconds for run in runs) / max(sum(run.frames for run in runs), 1)


def compare(
    dataset: Dataset,
    config: TrackConfig,
    methods: Sequence[Method],
    settings: SceneMetricSettings | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Track every scene with every method. Raises `InputError` for a scene without ground truth."""
    runs: dict[Method, list[TrackedScene]] = {method: [] for method in methods}
    metrics: dict[Method, list[SceneMetrics]] = {method: [] for method in methods}
    for name in dataset.scenes:
        scene = dataset.scene(name)
        if scene.ground_truth is None:
            raise InputError(f"scene {name}: expected ground truth to compare methods with")
        for method in methods:
            run = track_scene(scene, config.new_tracker(method), progress)
            runs[method].append(run)
            metrics[method].append(scene_metrics(scene.ground_truth, run.tracks, settings))
    return Comparison(
        {method: tuple(runs[method]) for method in methods},
        {method: SceneMetrics.pool(metrics[method]) for method in methods},
    )


def comparison_table(comparison: Comparison, title: str) -> FigureTable:
    """Return a table with a row for each method.

    Occluded: objects that were tracked while in view and are hidden now; a lost one counts with the cap.
    """
    columns = ("method", "position RMSE, m", "velocity RMSE, m/s", "occluded position RMSE, m", "MOTA")
    rows = []
    for method, m in comparison.metrics.items():
        numbers = (m.position.rmse, m.velocity.rmse, m.carried.rmse, m.mota)
        texts = (*map(cell, numbers), str(m.switches), f"{comparison.milliseconds_per_frame(method):.1f}")
        rows.append((method, *texts))
    return FigureTable(title, (*columns, "ID switches", "ms per frame"), tuple(rows))

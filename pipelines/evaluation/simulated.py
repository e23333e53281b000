"""Simulated traffic tracked and scored against the simulator's truth: exact, at every moment, hidden objects too."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from data_tools.metrics import LabelErrors, SceneBoxes, SceneMetrics, label_errors, scene_metrics_by_label
from pipelines.evaluation.errors import error_json, error_pictures, error_tables
from pipelines.evaluation.innovations import innovation_json, innovation_table
from pipelines.figures import FigureTable, cell
from pipelines.observers import Innovations
from pipelines.tracking import OnlineTracker, Progress, track_dataset
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.tracking import Observer
from saga_fg.types.dataset import Annotations, Dataset

_COLUMNS = (
    *("class", "MOTA", "MOTP", "recall", "IDS", "FP", "FN", "objects", "hidden", "... tracked", "carried error"),
    *("... median",),
)


@dataclass(frozen=True, eq=False)
class SimulatedEvaluation:
    """The figures of one tracker: over all classes and by class, pooled over the scenes."""

    scenes: tuple[str, ...]
    metrics: Mapping[str, SceneMetrics]
    errors: LabelErrors
    innovations: Mapping[str, FloatArray]

    def tables(self) -> list[FigureTable]:
        """For people."""
        title = (
            "Simulated traffic; MOTP and errors in m; carried: error of the track that last followed a hidden object"
        )
        rows = tuple((name, *_cells(metrics)) for name, metrics in self.metrics.items())
        innovations = [innovation_table(self.innovations)] if self.innovations else []
        return [FigureTable(title, _COLUMNS, rows), *error_tables(self.errors), *innovations]

    def figures(self) -> dict[str, Any]:
        """For programs."""
        return {
            "scenes": self.scenes,
            "tracking": {name: _figures(metrics) for name, metrics in self.metrics.items()},
            **error_json(self.errors),
            "innovations": innovation_json(self.innovations),
        }

    def pictures(self) -> dict[str, Any]:
        """matplotlib figures by name."""
        return error_pictures(self.errors)


def evaluate_simulated(
    dataset: Dataset, new_tracker: Callable[[Observer], OnlineTracker], progress: Progress | None = None
) -> SimulatedEvaluation:
    """Track every scene and score what comes out. Raises `InputError` for a scene without ground truth."""
    by_label: dict[str, list[SceneMetrics]] = {}
    errors, innovations = [], Innovations()
    for run in track_dataset(dataset, lambda: new_tracker(innovations), progress=progress):
        truth = run.scene.ground_truth
        if truth is None:
            raise InputError(f"scene {run.scene.name}: expected ground truth")
        for label, metrics in scene_metrics_by_label(truth, run.tracks).items():
            by_label.setdefault(label, []).append(metrics)
        visible = [Annotations(t.id[t.visible], t.boxes.select(t.visible), t.visible[t.visible]) for t in truth]
        labels = SceneBoxes.of_annotations(visible)
        errors.append(label_errors(labels, SceneBoxes.of_tracks(run.tracks), labels.boxes.velocity))
    pooled = {label: SceneMetrics.pool(parts) for label, parts in sorted(by_label.items())}
    overall = SceneMetrics.pool(pooled.values())
    return SimulatedEvaluation(
        dataset.scenes, {"overall": overall, **pooled}, LabelErrors.pool(errors), innovations.by_class
    )


def _cells(m: SceneMetrics) -> tuple[str, ...]:
    counts = (m.switches, m.false_positives, m.misses, m.objects, m.hidden_objects)
    shares = (cell(m.mota), cell(m.motp), cell(m.recall))
    return (*shares, *map(cell, counts), cell(m.hidden_recall), cell(m.carried.rmse), cell(m.carried.median))


def _figures(m: SceneMetrics) -> dict[str, float]:
    names = ("mota", "motp", "recall", "switches", "false_positives", "misses", "objects", "hidden_objects")
    figures = {name: getattr(m, name) for name in (*names, "hidden_recall")}
    samples = {"position": m.position, "velocity": m.velocity, "heading": m.heading, "carried": m.carried}
    samples |= {"hidden_position": m.hidden_position, "hidden_velocity": m.hidden_velocity}
    return figures | {f"{name}_rmse": sample.rmse for name, sample in samples.items()}

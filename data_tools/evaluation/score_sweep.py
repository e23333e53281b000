"""The metrics of the nuScenes tracking task, which sweep over scores (AMOTA), as a table, and for any data."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data_tools.figures import FigureTable, cell, count
from data_tools.metrics import (
    NuScenesClassMetrics,
    NuScenesTrackingMetrics,
    NuScenesTrackingScene,
    NuScenesTrackingSettings,
    SceneBoxes,
    nuscenes_tracking_metrics,
)
from saga_fg.types.dataset import Scene

TITLE = "Over all scores, as in the nuScenes tracking task, without a limit of range; the rest at the best MOTA"
_COLUMNS = (
    *("class", "AMOTA", "AMOTP", "MOTA", "MOTP", "recall", "IDS", "FRAG", "TP", "FP", "FN", "GT", "MT", "ML"),
    *("FAF", "TID", "LGD"),
)


def score_sweep(pairs: Sequence[tuple[Scene, SceneBoxes]]) -> NuScenesTrackingMetrics:
    """Score the tracks of scenes with ground truth by the metrics of the task: all classes, at any distance.

    Hidden objects are left out. A frame counts as one median step of time in TID and LGD.
    """
    scenes = []
    for scene, found in pairs:
        truth = SceneBoxes.of_annotations(scene.ground_truth or (), hidden=False)
        scenes.append(NuScenesTrackingScene(scene.timestamps, np.zeros((len(scene), 2)), truth, found))
    labels = sorted({label for each in scenes for t in (each.truth, each.found) for label in t.boxes.label.tolist()})
    steps = np.concatenate([np.empty(0), *(np.diff(each.timestamps) for each in scenes)])
    period = float(np.median(steps)) if len(steps) else 1.0
    settings = NuScenesTrackingSettings(class_range=dict.fromkeys(labels, np.inf), sample_period=period)
    return nuscenes_tracking_metrics(scenes, settings)


def sweep_table(title: str, metrics: NuScenesTrackingMetrics) -> FigureTable:
    """The figures of the task, a row for all classes and one for each."""
    rows = [("overall", metrics.overall), *metrics.per_class.items()]
    return FigureTable(title, _COLUMNS, tuple((name, *_cells(figures)) for name, figures in rows))


def best_thresholds(metrics: NuScenesTrackingMetrics) -> dict[str, float]:
    """The score threshold of best MOTA of each class that occurs; infinite for one that is never matched."""
    best = {}
    for label, curves in metrics.curves.items():
        reached = np.where(np.isfinite(curves.score), curves.mota, -np.inf)
        best[label] = float(curves.score[np.argmax(reached)]) if np.isfinite(curves.score).any() else np.inf
    return best


def _cells(f: NuScenesClassMetrics) -> tuple[str, ...]:
    shares = (cell(value) for value in (f.amota, f.amotp, f.mota, f.motp, f.recall))
    counts = (count(value) for value in (f.ids, f.frag, f.tp, f.fp, f.fn, f.gt, f.mt, f.ml))
    return (*shares, *counts, *(cell(value, 2) for value in (f.faf, f.tid, f.lgd)))

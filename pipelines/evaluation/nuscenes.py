"""A nuScenes tracking result scored: the official figures, errors at labels, calibration, HOTA."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.metrics import (
    LabelErrors,
    NuScenesTrackingMetrics,
    NuScenesTrackingScene,
    NuScenesTrackingSettings,
    TrackingFigures,
    TrackTable,
    label_errors,
    label_velocities,
    nuscenes_tracking_metrics,
)
from data_tools.nuscenes import NuScenes, read_scored_scenes
from data_tools.plots import recall_sweep
from pipelines.evaluation.errors import error_json, error_pictures, error_tables
from pipelines.evaluation.hota import HotaRow, hota, hota_json, hota_table
from pipelines.evaluation.innovations import innovation_json, innovation_table, journal_innovations
from pipelines.evaluation.placed_detections import PlacedBoxes, placed_detections
from pipelines.explaining import journal_of
from pipelines.figures import FigureTable, cell, count
from saga_fg.arrays import FloatArray

REACH = 1  # keyframes to either side for a label's velocity, 0.5 s
_COLUMNS = (
    *("class", "AMOTA", "AMOTP", "MOTA", "MOTP", "recall", "IDS", "FRAG", "TP", "FP", "FN", "GT", "MT", "ML"),
    *("FAF", "TID", "LGD"),
)


@dataclass(frozen=True, eq=False)
class NuScenesEvaluation:
    """The figures of one result over some scenes; `hota` is empty where it was not asked for."""

    scenes: tuple[str, ...]
    tracking: NuScenesTrackingMetrics
    errors: LabelErrors
    hota: Sequence[HotaRow] = ()
    innovations: Mapping[str, FloatArray] = field(default_factory=dict)

    def tables(self) -> list[FigureTable]:
        """For people."""
        first = nuscenes_table("nuScenes tracking metrics; AMOTP, MOTP in m, TID, LGD in s", self.tracking)
        innovations = [innovation_table(self.innovations)] if self.innovations else []
        return [first, *error_tables(self.errors), *innovations, *([hota_table(self.hota)] if self.hota else [])]

    def figures(self) -> dict[str, Any]:
        """For programs."""
        return {
            "scenes": self.scenes,
            "overall": self.tracking.overall,
            "per_class": self.tracking.per_class,
            "curves": self.tracking.curves,
            **error_json(self.errors),
            "innovations": innovation_json(self.innovations),
            "hota": hota_json(self.hota),
        }

    def pictures(self) -> dict[str, Any]:
        """matplotlib figures by name."""
        return {"recall": recall_sweep(self.tracking.curves), **error_pictures(self.errors)}


def evaluate_nuscenes(
    result: str | Path,
    dataroot: str | Path,
    version: str,
    scenes: Collection[str] | None = None,
    detections: Mapping[str, Path] | None = None,
    with_hota: bool = False,
    with_innovations: bool = False,
) -> NuScenesEvaluation:
    """Score the tracks of file `result` in the chosen scenes (None: all of the tables).

    detections  files by sensor, to judge errors on the labels that they match

    Raises `InputError` for missing or broken files, and for a result that lacks a sample of these scenes;
    `MissingExtraError` for HOTA without trackeval. Innovations are read from the journal beside the result.
    """
    scored = read_scored_scenes(result, dataroot, version, scenes)
    seen: dict[str, PlacedBoxes] = {}
    if detections:
        dataset = NuScenes(dataroot, version, detections, tuple(scored))
        seen = {name: placed_detections(dataset.scene(name)) for name in scored}
    tracking = nuscenes_tracking_metrics(list(scored.values()))
    pairs = [(_in_range(scene, scene.truth), _in_range(scene, scene.found)) for scene in scored.values()]
    return NuScenesEvaluation(
        tuple(scored),
        tracking,
        LabelErrors.pool(nuscenes_label_errors(scene, seen.get(name)) for name, scene in scored.items()),
        hota(pairs, _best_thresholds(tracking)) if with_hota else (),
        journal_innovations(journal_of(Path(result))) if with_innovations else {},
    )


def nuscenes_label_errors(scene: NuScenesTrackingScene, detections: PlacedBoxes | None = None) -> LabelErrors:
    """The errors at the labels of one scene, those without a LiDAR or radar point left out."""
    velocity = label_velocities(scene.truth, scene.timestamps, REACH)
    return label_errors(scene.truth, scene.found, velocity, detections)


def nuscenes_table(title: str, metrics: NuScenesTrackingMetrics) -> FigureTable:
    """The official figures, a row for all classes and one for each."""
    rows = [("overall", metrics.overall), *metrics.per_class.items()]
    return FigureTable(title, _COLUMNS, tuple((name, *_cells(figures)) for name, figures in rows))


def _in_range(scene: NuScenesTrackingScene, table: TrackTable) -> TrackTable:
    """The boxes within the distance from the vehicle up to which their class is scored."""
    limits = NuScenesTrackingSettings().class_range
    reach = np.array([limits.get(label, 0.0) for label in table.boxes.label.tolist()])
    offset = table.boxes.position[:, :2] - scene.ego_position[table.moment]
    return table.select(np.flatnonzero(np.hypot(offset[:, 0], offset[:, 1]) < reach))


def _best_thresholds(metrics: NuScenesTrackingMetrics) -> dict[str, float]:
    """The score threshold of best MOTA of each class that occurs; infinite for one that is never matched."""
    best = {}
    for label, curves in metrics.curves.items():
        reached = np.where(np.isfinite(curves.score), curves.mota, -np.inf)
        best[label] = float(curves.score[np.argmax(reached)]) if np.isfinite(curves.score).any() else np.inf
    return best


def _cells(f: TrackingFigures) -> tuple[str, ...]:
    shares = (cell(value) for value in (f.amota, f.amotp, f.mota, f.motp, f.recall))
    counts = (count(value) for value in (f.ids, f.frag, f.tp, f.fp, f.fn, f.gt, f.mt, f.ml))
    return (*shares, *counts, *(cell(value, 2) for value in (f.faf, f.tid, f.lgd)))

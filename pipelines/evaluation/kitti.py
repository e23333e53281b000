"""A KITTI tracking result scored: figures averaged over recall, errors at labels, calibration, HOTA."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from data_tools.datasets.kitti.scored_sequences import ScoredSequence
from data_tools.metrics import (
    KittiTrackingMetrics,
    KittiTrackingSequence,
    LabelErrors,
    kitti_tracking_metrics,
    label_errors,
    label_velocities,
)
from pipelines.evaluation.errors import error_json, error_pictures, error_tables
from pipelines.evaluation.hota import HotaRow, hota_json, hota_table, kitti_hota
from pipelines.evaluation.innovations import innovation_json, innovation_table
from pipelines.evaluation.placed_detections import placed_detections
from pipelines.figures import FigureTable, cell
from saga_fg.numerics.arrays import FloatArray

CLASSES = ("car", "pedestrian", "cyclist")
IOUS = (0.25, 0.5, 0.7)
REACH = 5  # frames to either side for a label's velocity, 0.5 s
_COLUMNS = (
    *("class", "3D IoU", "sAMOTA", "AMOTA", "AMOTP", "MOTA", "MOTP", "IDS", "FRAG", "recall", "precision"),
    *("TP", "FP", "FN", "GT", "MT", "ML"),
)
ByIou = Mapping[float, KittiTrackingMetrics]


@dataclass(frozen=True, eq=False)
class KittiEvaluation:
    """The figures of one result over some sequences: by class that occurs, and 3D IoU."""

    sequences: tuple[str, ...]
    tracking: Mapping[str, ByIou]
    errors: LabelErrors
    hota: Sequence[HotaRow] = ()
    innovations: Mapping[str, FloatArray] = field(default_factory=dict)

    def tables(self) -> list[FigureTable]:
        """For people."""
        first = kitti_table("KITTI 3D tracking metrics, in %", self.tracking)
        innovations = [innovation_table(self.innovations)] if self.innovations else []
        return [first, *error_tables(self.errors), *innovations, *([hota_table(self.hota)] if self.hota else [])]

    def figures(self) -> dict[str, Any]:
        """For programs."""
        return {
            "sequences": self.sequences,
            "per_class": self.tracking,
            **error_json(self.errors),
            "innovations": innovation_json(self.innovations),
            "hota": hota_json(self.hota),
        }

    def pictures(self) -> dict[str, Any]:
        """matplotlib figures by name."""
        return error_pictures(self.errors)


def evaluate_kitti(
    scored: Mapping[str, ScoredSequence],
    classes: Sequence[str] = CLASSES,
    ious: Sequence[float] = IOUS,
    with_hota: bool = False,
    innovations: Mapping[str, FloatArray] | None = None,
) -> KittiEvaluation:
    """Score the tracks of the sequences that were read; errors are judged at the labels that their detections match.

    innovations  of the journal of the run, by class, to be among the figures

    Raises `MissingExtraError` for HOTA without trackeval.
    """
    pairs = [KittiTrackingSequence(each.labels, each.result) for each in scored.values()]
    tracking: dict[str, ByIou] = {}
    for label in classes:
        by_iou = {iou: figures for iou in ious if (figures := kitti_tracking_metrics(pairs, label, iou)) is not None}
        if by_iou:
            tracking[label] = by_iou
    best = {label: next(iter(by_iou.values())).threshold for label, by_iou in tracking.items()}
    return KittiEvaluation(
        tuple(scored),
        tracking,
        LabelErrors.pool(kitti_label_errors(each, classes) for each in scored.values()),
        kitti_hota(pairs, best) if with_hota else (),
        innovations or {},
    )


def kitti_label_errors(scored: ScoredSequence, classes: Sequence[str]) -> LabelErrors:
    """The errors at the labels of the classes in one sequence: those that a detection matches, if there are any."""
    truth = scored.truth.select(np.flatnonzero(np.isin(scored.truth.boxes.label, classes)))
    velocity = label_velocities(truth, scored.scene.timestamps, REACH)
    return label_errors(truth, scored.found, velocity, placed_detections(scored.scene) if scored.scene.frames else None)


def kitti_table(title: str, tracking: Mapping[str, ByIou]) -> FigureTable:
    """A row for each class and overlap."""
    rows = ((label, f"{iou:g}", f) for label, by_iou in tracking.items() for iou, f in by_iou.items())
    return FigureTable(title, _COLUMNS, tuple((label, iou, *_cells(f)) for label, iou, f in rows))


def _cells(f: KittiTrackingMetrics) -> tuple[str, ...]:
    def percent(*values: float) -> tuple[str, ...]:
        return tuple(cell(100 * value, 2) for value in values)

    counts = (cell(value) for value in (f.tp, f.fp, f.fn, f.gt))
    first = percent(f.samota, f.amota, f.amotp, f.mota, f.motp)
    return (*first, cell(f.ids), cell(f.frag), *percent(f.recall, f.precision), *counts, *percent(f.mt, f.ml))

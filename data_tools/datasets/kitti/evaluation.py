"""A KITTI tracking result scored: figures averaged over recall, errors at labels, calibration, HOTA.

HOTA is of what the benchmark judges (`data_tools.metrics.kitti_tracking.evaluated_objects`), by the overlap in the
image as well, as published figures are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from data_tools.datasets.kitti.scored_sequences import ScoredSequence
from data_tools.evaluation import Evaluation
from data_tools.evaluation.hota import HotaRow, mean_scores
from data_tools.evaluation.placed_detections import placed_detections
from data_tools.figures import FigureTable, cell
from data_tools.kitti_objects import KittiObjects
from data_tools.metrics import (
    KittiSimilarity,
    KittiTrackingMetrics,
    KittiTrackingSequence,
    LabelErrors,
    SceneBoxes,
    WholeTracks,
    kitti_hota_metrics,
    kitti_tracking_metrics,
    label_errors,
    label_velocities,
    whole_tracks,
)
from saga_fg.numerics.arrays import FloatArray

CLASSES = ("car", "pedestrian", "cyclist")
IOUS = (0.25, 0.5, 0.7)
REACH = 5  # frames to either side for a label's velocity, 0.5 s
_COLUMNS = (
    *("class", "3D IoU", "sAMOTA", "safe", "AMOTA", "AMOTP", "MOTA", "MOTP", "IDS", "FRAG", "recall", "precision"),
    *("TP", "FP", "FN", "GT", "MT", "ML"),
)
SIMILARITIES: dict[str, KittiSimilarity] = {"image": "image", "2D": "bev_iou", "3D": "iou_3d"}
ByIou = Mapping[float, KittiTrackingMetrics]


def evaluate_kitti(
    scored: Mapping[str, ScoredSequence],
    classes: Sequence[str] = CLASSES,
    ious: Sequence[float] = IOUS,
    with_hota: bool = False,
    innovations: Mapping[str, FloatArray] | None = None,
    persons: bool = False,
) -> Evaluation:
    """Score the tracks of the sequences that were read; errors are those at the labels that their detections match.

    persons      whether boxes at `Person` labels are exempt for pedestrians, see `kitti_tracking_metrics`
    innovations  of the journal of the run, by class, to be among the figures

    Raises `MissingExtraError` for HOTA without trackeval.
    """
    pairs = [KittiTrackingSequence(each.labels, each.result) for each in scored.values()]
    tracking: dict[str, ByIou] = {}
    for label in classes:
        found = ((iou, kitti_tracking_metrics(pairs, label, iou, persons)) for iou in ious)
        by_iou = {iou: figures for iou, figures in found if figures is not None}
        if by_iou:
            tracking[label] = by_iou
    best = {label: next(iter(by_iou.values())).threshold_safe for label, by_iou in tracking.items()}
    return Evaluation(
        kitti_table("KITTI 3D tracking metrics, in %", tracking),
        {"sequences": tuple(scored), "per_class": tracking},
        LabelErrors.pool(kitti_label_errors(each, classes) for each in scored.values()),
        WholeTracks.concatenate(
            [
                whole_tracks(_of_classes(each.truth, classes), _of_classes(each.found, classes))
                for each in scored.values()
            ]
        ),
        kitti_hota(pairs, best) if with_hota else (),
        innovations or {},
    )


def kitti_label_errors(scored: ScoredSequence, classes: Sequence[str]) -> LabelErrors:
    """The errors at the labels of the classes in one sequence: those that a detection matches, if there are any."""
    truth = _of_classes(scored.truth, classes)
    velocity = label_velocities(truth, scored.scene.timestamps, REACH)
    return label_errors(truth, scored.found, velocity, placed_detections(scored.scene) if scored.scene.frames else None)


def _of_classes(table: SceneBoxes, classes: Sequence[str]) -> SceneBoxes:
    return table.select(np.isin(table.boxes.label, classes))


def kitti_hota(sequences: Sequence[KittiTrackingSequence], thresholds: Mapping[str, float]) -> list[HotaRow]:
    """Judge the tracks that reach the threshold of their class. Raises `MissingExtraError` without trackeval."""
    rows = []
    for label, threshold in thresholds.items():
        scored = [replace(each, found=_surer_lines(each.found, label, threshold)) for each in sequences]
        for overlap, similarity in SIMILARITIES.items():
            rows.append(HotaRow(label, overlap, threshold, kitti_hota_metrics(scored, label, similarity)))
    return rows


def _surer_lines(found: KittiObjects, label: str, threshold: float) -> KittiObjects:
    """Select the objects of a class in tracks whose mean score is at least `threshold`; no score counts as infinite."""
    rows = np.flatnonzero(np.char.lower(found.type) == label)
    score = np.nan_to_num(found.score[rows], nan=np.inf)
    return found.select(rows[mean_scores(found.track_id[rows], score) >= threshold - 1e-12])


def kitti_table(title: str, tracking: Mapping[str, ByIou]) -> FigureTable:
    """A row for each class and overlap."""
    rows = ((label, f"{iou:g}", f) for label, by_iou in tracking.items() for iou, f in by_iou.items())
    return FigureTable(title, _COLUMNS, tuple((label, iou, *_cells(f)) for label, iou, f in rows))


def _cells(f: KittiTrackingMetrics) -> tuple[str, ...]:
    def percent(*values: float) -> tuple[str, ...]:
        return tuple(cell(100 * value, 2) for value in values)

    counts = (cell(value) for value in (f.tp, f.fp, f.fn, f.gt))
    first = percent(f.samota, f.samota_safe, f.amota, f.amotp, f.mota, f.motp)
    return (*first, cell(f.ids), cell(f.frag), *percent(f.recall, f.precision), *counts, *percent(f.mt, f.ml))

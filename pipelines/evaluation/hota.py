"""HOTA, CLEAR and Identity figures of a result, class by class, in the plane (2D) and in space (3D).

KITTI's are of what its benchmark judges (`data_tools.metrics.kitti_tracking.evaluated_objects`), by the overlap in the
image as well, as published figures are.

These metrics judge one set of tracks, without a sweep over scores. The tracks judged are those whose mean score reaches
the class's threshold of best MOTA, as published figures choose them too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from data_tools.kitti_objects import KittiObjects
from data_tools.metrics import (
    HotaMetrics,
    KittiSimilarity,
    KittiTrackingSequence,
    SceneBoxes,
    hota_metrics,
    kitti_hota_metrics,
)
from data_tools.metrics.hota import Similarity
from pipelines.figures import FigureTable, cell
from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray

SIMILARITIES: dict[str, Similarity] = {"2D": "bev_iou", "3D": "iou_3d"}
KITTI_SIMILARITIES: dict[str, KittiSimilarity] = {"image": "image", "2D": "bev_iou", "3D": "iou_3d"}
_COLUMNS = (
    *("class", "overlap", "score >=", "HOTA", "DetA", "AssA", "LocA", "MOTA", "MOTP", "IDS", "FRAG"),
    *("IDF1", "IDP", "IDR"),
)


@dataclass(frozen=True, eq=False)
class HotaRow:
    """One class at one similarity: `overlap` is 2D, 3D or image; `threshold`: least mean score of the tracks judged."""

    label: str
    overlap: str
    threshold: float
    figures: HotaMetrics


def hota(scenes: Sequence[tuple[SceneBoxes, SceneBoxes]], thresholds: Mapping[str, float]) -> list[HotaRow]:
    """Judge (truth, found) of all scenes for the classes of `thresholds`. Raises `MissingExtraError` w/o trackeval."""
    rows = []
    for label, threshold in thresholds.items():
        judged = [(truth, _surer(found, label, threshold)) for truth, found in scenes]
        for overlap, similarity in SIMILARITIES.items():
            rows.append(HotaRow(label, overlap, threshold, hota_metrics(judged, label, similarity)))
    return rows


def kitti_hota(sequences: Sequence[KittiTrackingSequence], thresholds: Mapping[str, float]) -> list[HotaRow]:
    """The same for the lines of KITTI's files."""
    rows = []
    for label, threshold in thresholds.items():
        judged = [replace(each, found=_surer_lines(each.found, label, threshold)) for each in sequences]
        for overlap, similarity in KITTI_SIMILARITIES.items():
            rows.append(HotaRow(label, overlap, threshold, kitti_hota_metrics(judged, label, similarity)))
    return rows


def hota_table(rows: Sequence[HotaRow]) -> FigureTable:
    """For people; in percent, as these figures are published."""
    return FigureTable(
        "HOTA, CLEAR and Identity, in %; pairs from an overlap of 0.5 on count for CLEAR and Identity",
        _COLUMNS,
        tuple((row.label, row.overlap, cell(row.threshold), *_cells(row.figures)) for row in rows),
    )


def hota_json(rows: Sequence[HotaRow]) -> dict[str, Any]:
    """For programs: by class, then overlap."""
    result: dict[str, Any] = {}
    for row in rows:
        result.setdefault(row.label, {"threshold": row.threshold})[row.overlap] = row.figures
    return result


def _surer(found: SceneBoxes, label: str, threshold: float) -> SceneBoxes:
    """The tracks of a class whose mean score is at least `threshold`."""
    rows = np.flatnonzero(found.boxes.label == label)
    return found.select(rows[_mean_scores(found.id[rows], found.score[rows]) >= threshold - 1e-12])


def _surer_lines(found: KittiObjects, label: str, threshold: float) -> KittiObjects:
    """The same for the lines of a file; those without a score are sure."""
    rows = np.flatnonzero(np.char.lower(found.type) == label)
    score = np.nan_to_num(found.score[rows], nan=np.inf)
    return found.select(rows[_mean_scores(found.track_id[rows], score) >= threshold - 1e-12])


def _mean_scores(track: IntArray | StrArray, score: FloatArray) -> FloatArray:
    """(N,) the mean score of each box's track."""
    _, number = np.unique(track, return_inverse=True)
    return np.asarray((np.bincount(number, weights=score) / np.maximum(np.bincount(number), 1))[number])


def _cells(f: HotaMetrics) -> tuple[str, ...]:
    percent = (cell(100 * value, 2) for value in (f.hota, f.deta, f.assa, f.loca, f.mota, f.motp))
    identity = (cell(100 * value, 2) for value in (f.idf1, f.idp, f.idr))
    return (*percent, cell(f.ids), cell(f.frag), *identity)

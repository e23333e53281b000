"""HOTA, CLEAR and Identity figures of a result, class by class, in the plane (2D) and in space (3D).

These metrics judge one set of tracks, without a sweep over scores. The tracks scored are those whose mean score reaches
the class's threshold of best MOTA, as published figures choose them too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from data_tools.figures import FigureTable, cell
from data_tools.metrics import HotaMetrics, SceneBoxes, hota_metrics
from data_tools.metrics.hota import Similarity
from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray

SIMILARITIES: dict[str, Similarity] = {"2D": "bev_iou", "3D": "iou_3d"}
_COLUMNS = (
    *("class", "overlap", "score >=", "HOTA", "DetA", "AssA", "LocA", "MOTA", "MOTP", "IDS", "FRAG"),
    *("IDF1", "IDP", "IDR"),
)


@dataclass(frozen=True, eq=False)
class HotaRow:
    """One class at one similarity: `overlap` is 2D, 3D or image; `threshold`: least mean score of its tracks."""

    label: str
    overlap: str
    threshold: float
    figures: HotaMetrics


def hota(scenes: Sequence[tuple[SceneBoxes, SceneBoxes]], thresholds: Mapping[str, float]) -> list[HotaRow]:
    """Judge (truth, found) of all scenes for the classes of `thresholds`. Raises `MissingExtraError` w/o trackeval."""
    rows = []
    similarities = _similarities(scenes)
    for label, threshold in thresholds.items():
        scored = [(truth, _surer(found, label, threshold)) for truth, found in scenes]
        for overlap, similarity in similarities.items():
            rows.append(HotaRow(label, overlap, threshold, hota_metrics(scored, label, similarity)))
    return rows


def _similarities(scenes: Sequence[tuple[SceneBoxes, SceneBoxes]]) -> dict[str, Similarity]:
    """The overlaps that all boxes have; where sizes or headings are missing, the nearness of centres, 0 from 4 m on."""
    tables = [table.boxes for one in scenes for table in one]
    plane = all(np.isfinite(boxes.size[:, :2]).all() and np.isfinite(boxes.yaw).all() for boxes in tables)
    if not plane:
        return {"centre": "centre"}
    if not all(np.isfinite(boxes.size[:, 2]).all() for boxes in tables):
        return {"2D": "bev_iou"}
    return SIMILARITIES


def hota_table(rows: Sequence[HotaRow]) -> FigureTable:
    """Table for people, in percent as such figures are published."""
    return FigureTable(
        "HOTA, CLEAR and Identity, in %; pairs from an overlap of 0.5 on count for CLEAR and Identity",
        _COLUMNS,
        tuple((row.label, row.overlap, cell(row.threshold), *_cells(row.figures)) for row in rows),
    )


def hota_json(rows: Sequence[HotaRow]) -> dict[str, Any]:
    """Figures for programs, by class and overlap."""
    result: dict[str, Any] = {}
    for row in rows:
        result.setdefault(row.label, {"threshold": row.threshold})[row.overlap] = row.figures
    return result


def _surer(found: SceneBoxes, label: str, threshold: float) -> SceneBoxes:
    """The tracks of a class whose mean score is at least `threshold`."""
    rows = np.flatnonzero(found.boxes.label == label)
    return found.select(rows[mean_scores(found.id[rows], found.score[rows]) >= threshold - 1e-12])


def mean_scores(track: IntArray | StrArray, score: FloatArray) -> FloatArray:
    """(N,) the mean score of each box's track."""
    _, number = np.unique(track, return_inverse=True)
    return np.asarray((np.bincount(number, weights=score) / np.maximum(np.bincount(number), 1))[number])


def _cells(f: HotaMetrics) -> tuple[str, ...]:
    percent = (cell(100 * value, 2) for value in (f.hota, f.deta, f.assa, f.loca, f.mota, f.motp))
    identity = (cell(100 * value, 2) for value in (f.idf1, f.idp, f.idr))
    return (*percent, cell(f.ids), cell(f.frag), *identity)

"""A nuScenes tracking result scored: the official figures, overall and by class."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data_tools.metrics import NuScenesTrackingMetrics, TrackingFigures, nuscenes_tracking_metrics
from data_tools.nuscenes import read_scored_scenes
from pipelines.figures import FigureTable, cell, count

_COLUMNS = (
    *("class", "AMOTA", "AMOTP", "MOTA", "MOTP", "recall", "IDS", "FRAG", "TP", "FP", "FN", "GT", "MT", "ML"),
    *("FAF", "TID", "LGD"),
)


@dataclass(frozen=True, eq=False)
class NuScenesEvaluation:
    """The figures of one result file over some scenes."""

    scenes: tuple[str, ...]
    tracking: NuScenesTrackingMetrics

    def tables(self) -> list[FigureTable]:
        """For people."""
        return [nuscenes_table("nuScenes tracking metrics; AMOTP, MOTP in m, TID, LGD in s", self.tracking)]

    def figures(self) -> dict[str, Any]:
        """For programs."""
        return {"scenes": self.scenes, "overall": self.tracking.overall, "per_class": self.tracking.per_class}


def evaluate_nuscenes(
    result: str | Path, dataroot: str | Path, version: str, scenes: Collection[str] | None = None
) -> NuScenesEvaluation:
    """Score the tracks of file `result` in the chosen scenes (None: all of the tables).

    Raises `InputError` for missing or broken files, and for a result that lacks a sample of these scenes.
    """
    scored = read_scored_scenes(result, dataroot, version, scenes)
    return NuScenesEvaluation(tuple(scored), nuscenes_tracking_metrics(list(scored.values())))


def nuscenes_table(title: str, metrics: NuScenesTrackingMetrics) -> FigureTable:
    """The official figures, a row for all classes and one for each."""
    rows = [("overall", metrics.overall), *metrics.per_class.items()]
    return FigureTable(title, _COLUMNS, tuple((name, *_cells(figures)) for name, figures in rows))


def _cells(f: TrackingFigures) -> tuple[str, ...]:
    shares = (cell(value) for value in (f.amota, f.amotp, f.mota, f.motp, f.recall))
    counts = (count(value) for value in (f.ids, f.frag, f.tp, f.fp, f.fn, f.gt, f.mt, f.ml))
    return (*shares, *counts, *(cell(value, 2) for value in (f.faf, f.tid, f.lgd)))

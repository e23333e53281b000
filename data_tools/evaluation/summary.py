"""The figures that matter most of one result, in a table narrow enough for any terminal (80 columns)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data_tools.evaluation.hota import HotaRow
from data_tools.evaluation.score_sweep import best_thresholds
from data_tools.figures import FigureTable, cell
from data_tools.metrics import LabelErrors, NuScenesTrackingMetrics, calibration, error_summary, errors_by_class

LEGEND = (
    "AMOTA: mean over all scores. score: that of the best MOTA; from it on HOTA,\n"
    "MOTA, recall, identity switches (IDS), false boxes (FP). m, m/s: RMSE of places\n"
    "and velocities. in 90 %: share of errors in 90 % ellipses (right: 0.90)."
)
_COLUMNS = ("class", "AMOTA", "HOTA", "score", "MOTA", "recall", "IDS", "FP", "m", "m/s", "in 90 %")
_LONGEST = 14  # characters of a class


def summary_table(sweep: NuScenesTrackingMetrics, errors: LabelErrors, hota: Sequence[HotaRow] = ()) -> FigureTable:
    """One row for all classes and one for each that has true objects; HOTA by the first overlap there is."""
    by_class, scores = errors_by_class(errors), best_thresholds(sweep)
    quality: dict[str, float] = {}
    for row in hota:
        quality.setdefault(row.label, row.figures.hota)
    quality["overall"] = float(np.mean([quality[label] for label in scores if label in quality] or [np.nan]))
    rows = []
    for label in ("overall", *scores):
        f = sweep.overall if label == "overall" else sweep.per_class[label]
        error, fit = (
            (error_summary(by_class[label]), calibration(by_class[label])) if label in by_class else (None, None)
        )
        shares = (f.amota, quality.get(label, np.nan), scores.get(label, np.nan), f.mota, f.recall)
        rows.append(
            (
                label if len(label) <= _LONGEST else f"{label[: _LONGEST - 1]}~",
                *(cell(value, 2) for value in shares),
                *(cell(value, 0) for value in (f.ids, f.fp)),
                *(cell(value, 2) for value in ((error.position, error.velocity) if error else (np.nan, np.nan))),
                cell(fit.coverage[0.9] if fit and fit.boxes else np.nan, 2),
            )
        )
    return FigureTable("Tracks beside the ground truth", _COLUMNS, tuple(rows))

"""Score threshold of the tracks on a page: that of the best MOTA, as in `evaluate`, if there is ground truth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import chain

import numpy as np

from data_tools.evaluation.score_sweep import best_thresholds, score_sweep
from pipelines.report.scenes import ReportScene

PLAIN = 0.3
"""Threshold without ground truth, or where no score makes tracks better than none."""


def start_thresholds(scenes: Sequence[ReportScene]) -> dict[str, float]:
    """Return the least score to show first, by the tracker's name: that of the class with the most true objects.

    Where all scores are below `PLAIN`, all tracks are shown.
    """
    names = dict.fromkeys(chain.from_iterable(scene.tracks for scene in scenes))
    return {name: _threshold(scenes, name) for name in names}


def _threshold(scenes: Sequence[ReportScene], name: str) -> float:
    mine = [each for each in scenes if name in each.tracks]
    scores = np.concatenate([each.tracks[name].score for each in mine])
    lowest = PLAIN if (scores >= PLAIN).any() else min(0.0, float(scores.min(initial=0.0)))
    judged = [each for each in mine if each.scene.ground_truth is not None]
    if not judged:
        return lowest
    sweep = score_sweep([(each.scene, each.tracks[name]) for each in judged])
    best = best_thresholds(sweep)
    common = Counter({label: int(sweep.per_class[label].gt) for label in best}).most_common(1)
    if not common or not np.isfinite(best[common[0][0]]) or not sweep.per_class[common[0][0]].mota > 0:
        return lowest
    return float(np.floor(100 * best[common[0][0]]) / 100)

"""The metrics of the nuScenes tracking task, for one class and over all classes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Self

import numpy as np

from saga_fg.numerics.arrays import FloatArray

SUMMED = frozenset({"gt", "tp", "fp", "fn", "ids", "frag", "mt", "ml"})


@dataclass(frozen=True)
class NuScenesClassMetrics:
    """Metrics of one class, at the threshold with the highest MOTA (amota and amotp: over all); NaN where undefined.

    amota   mean over the sweep of MOTAR = max(0, 1 - (ids + fp + fn - (1 - r) gt) / (r gt)), r = tp / gt
    amotp   mean over the sweep of MOTP, m
    mota    max(0, 1 - (ids + fp + fn) / gt);  motp  mean distance of the pairs, m;  recall  (tp + ids) / gt
    gt      true boxes, including those interpolated in gaps
    tp      matches that are no switches;  fp, fn  false and missed boxes;  ids  identity switches;  frag  fragments
    mt, ml  objects mostly tracked, mostly lost;  faf  false alarms per 100 frames
    tid, lgd  mean time to the first match, mean longest gap, s
    """

    amota: float
    amotp: float
    recall: float
    motar: float
    gt: float
    mota: float
    motp: float
    mt: float
    ml: float
    faf: float
    tp: float
    fp: float
    fn: float
    ids: float
    frag: float
    tid: float
    lgd: float

    @classmethod
    def undefined(cls) -> Self:
        """A class without any true box."""
        return cls(**{field.name: float("nan") for field in fields(cls)})

    @classmethod
    def over_classes(cls, classes: Iterable[NuScenesClassMetrics]) -> Self:
        """Sums of the counts, means of the rest over the classes where they are defined (official, but for gt: summed,
        where the official evaluation prints the mean)."""
        parts = list(classes)
        result = {}
        for field in fields(cls):
            values = np.array([getattr(part, field.name) for part in parts])
            known = values[~np.isnan(values)]
            if field.name in SUMMED:
                result[field.name] = float(known.sum())
            else:
                result[field.name] = float(known.mean()) if len(known) else float("nan")
        return cls(**result)


@dataclass(frozen=True, eq=False)
class RecallCurves:
    """One class over the sweep, each (T,), from the highest hypothetical recall to the lowest; NaN where not reached.

    score is the threshold that the recall asks for; the others are as in `NuScenesClassMetrics`.
    """

    hypothetical_recall: FloatArray
    score: FloatArray
    recall: FloatArray
    motar: FloatArray
    mota: FloatArray
    motp: FloatArray
    fp: FloatArray
    fn: FloatArray
    ids: FloatArray

"""Innovations and their covariances by class (NIS): the tracks and the noise of the detections together.

The squared distance in sigmas of a track and the detection it took has 2 degrees of freedom: its mean is 2 if both
covariances are right. What lies outside the gate is never matched, which lowers the mean by little.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from data_tools.figures import FigureTable, cell
from data_tools.metrics import coverages
from saga_fg.numerics.arrays import FloatArray

_COLUMNS = ("class", "matches", "NIS / 2", "median", "in 50 %", "in 90 %", "in 99 %")


def innovation_table(by_class: Mapping[str, FloatArray]) -> FigureTable:
    """Table for people."""
    title = "Innovations: NIS / 2 and median are 1 if the covariances of tracks and detections are right"
    return FigureTable(title, _COLUMNS, tuple((label, *_cells(values)) for label, values in by_class.items()))


def innovation_json(by_class: Mapping[str, FloatArray]) -> dict[str, Any]:
    """Figures for programs."""
    return {
        label: {"matches": len(values), "nis": values.mean() / 2, "median": _median(values), "held": coverages(values)}
        for label, values in by_class.items()
    }


def _cells(values: FloatArray) -> tuple[str, ...]:
    shares = (cell(share) for share in coverages(values).values())
    return (cell(len(values)), cell(float(values.mean()) / 2, 2), cell(_median(values), 2), *shares)


def _median(values: FloatArray) -> float:
    """Over that of the chi-square distribution with 2 degrees of freedom."""
    return float(np.median(values) / (2 * np.log(2)))

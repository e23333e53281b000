"""Errors at labels and calibration, class by class, as tables and for programs."""

from __future__ import annotations

from typing import Any

import numpy as np

from data_tools.figures import FigureTable, cell
from data_tools.metrics import EllipseCoverage, ErrorSummary, LabelErrors, calibration, error_summary, errors_by_class
from data_tools.plots import calibration_plot, error_histograms

_ERRORS = (
    *("class", "labels", "with track", "position", "detection", "velocity", "velocity parked"),
    *("velocity moving", "unknown", "heading", "flipped"),
)
_CALIBRATION = ("class", "objects", "boxes", "ANEES / 2", "median", "in 50 %", "in 90 %", "in 99 %", "verdict")


def error_tables(errors: LabelErrors) -> list[FigureTable]:
    """RMSE of tracks (and of detections) at the labels; and, if there are covariances, how well they fit."""
    classes = errors_by_class(errors)
    title = "RMSE at labels: position in m, velocity in m/s, heading in degrees"
    tables = [
        FigureTable(title, _ERRORS, tuple((name, *_error_cells(error_summary(e))) for name, e in classes.items()))
    ]
    calibrations = {name: calibration(e) for name, e in classes.items()}
    if any(c.boxes for c in calibrations.values()):
        title = "Calibration: share of errors within the tracks' ellipses; ANEES / 2 and median: 1 is right"
        rows = tuple((name, *_calibration_cells(c)) for name, c in calibrations.items())
        tables.append(FigureTable(title, _CALIBRATION, rows))
    return tables


def error_json(errors: LabelErrors) -> dict[str, Any]:
    """Errors and calibration by class, for programs."""
    classes = errors_by_class(errors)
    fits = {name: calibration(e) for name, e in classes.items()}
    return {
        "errors": {name: error_summary(e) for name, e in classes.items()},
        "calibration": {
            name: {
                **{
                    field: getattr(c, field)
                    for field in ("objects", "boxes", "anees", "median_nees", "coverage", "enough_data")
                },
                "consistent": c.consistent if c.enough_data else None,
            }
            for name, c in fits.items()
        },
    }


def error_pictures(errors: LabelErrors) -> dict[str, Any]:
    """matplotlib figures by name: error histograms and, if there are covariances, how well they fit."""
    pictures = {"errors": error_histograms(errors)}
    return pictures | ({"calibration": calibration_plot(errors)} if np.isfinite(errors.nees).any() else {})


def _error_cells(f: ErrorSummary) -> tuple[str, ...]:
    errors = (f.position, f.detection, f.velocity, f.velocity_parked, f.velocity_moving)
    heading = cell(float(np.degrees(f.heading)), 1)
    return (
        cell(f.labels),
        cell(f.tracked),
        *(cell(x) for x in errors),
        cell(f.velocity_unknown),
        heading,
        cell(f.flipped),
    )


def _calibration_cells(c: EllipseCoverage) -> tuple[str, ...]:
    verdict = ("consistent" if c.consistent else "inconsistent") if c.enough_data else "too few boxes"
    shares = (cell(share) for share in c.coverage.values())
    return (cell(c.objects), cell(c.boxes), cell(c.anees, 2), cell(c.median_nees, 2), *shares, verdict)

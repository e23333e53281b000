"""Summary of the errors at labels: root mean squares, and the consistency of the covariances.

The shares of errors within the tracks' ellipses (`data_tools.metrics.consistency`) are meaningful for classes with
enough objects and boxes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from data_tools.metrics.consistency import coverages
from data_tools.metrics.label_errors import LabelErrors

FEWEST_OBJECTS, FEWEST_BOXES = 20, 500
BANDS = {0.5: (0.4, 0.6), 0.9: (0.85, 0.95), 0.99: (0.96, 1.0)}
OVERALL = "overall"


@dataclass(frozen=True)
class ErrorSummary:
    """Figures of one class, NaN where undefined.

    labels, tracked      matched labels, and those of them with a track
    position, detection  RMSE of tracks and of detections on the same labels, m
    velocity, velocity_parked, velocity_moving   RMSE, m/s, of known velocities
    velocity_unknown     labels of known velocity whose track has none
    heading              RMSE, rad; flipped: share of headings off by more than 90 degrees
    """

    labels: int
    tracked: int
    position: float
    detection: float
    velocity: float
    velocity_parked: float
    velocity_moving: float
    velocity_unknown: int
    heading: float
    flipped: float


@dataclass(frozen=True)
class EllipseCoverage:
    """Consistency of the covariances of one class.

    objects, boxes  that have a track with a covariance
    anees           mean NEES over its 2 degrees of freedom: 1 if the covariances are right
    median_nees     over that of the chi-square distribution
    coverage        share of the errors within the ellipse, by its probability
    """

    objects: int
    boxes: int
    anees: float
    median_nees: float
    coverage: Mapping[float, float]

    @property
    def enough_data(self) -> bool:
        """True with enough objects and boxes for a conclusion."""
        return self.objects >= FEWEST_OBJECTS and self.boxes >= FEWEST_BOXES

    @property
    def consistent(self) -> bool:
        """True if each share is within its band."""
        return all(low <= self.coverage[p] <= high for p, (low, high) in BANDS.items())


def error_summary(errors: LabelErrors) -> ErrorSummary:
    """Summarise errors."""
    heading = errors.sample("heading").values
    moving = errors.moving
    tracked = errors.matched & errors.tracked
    return ErrorSummary(
        labels=int(errors.matched.sum()),
        tracked=int(tracked.sum()),
        position=errors.sample("position").rmse,
        detection=errors.sample("detection").rmse,
        velocity=errors.sample("velocity").rmse,
        velocity_parked=errors.sample("velocity", ~moving).rmse,
        velocity_moving=errors.sample("velocity", moving).rmse,
        velocity_unknown=int((tracked & np.isfinite(errors.speed) & np.isnan(errors.velocity)).sum()),
        heading=errors.sample("heading").rmse,
        flipped=float(np.mean(heading > np.pi / 2)) if len(heading) else float("nan"),
    )


def calibration(errors: LabelErrors) -> EllipseCoverage:
    """Compare errors with their covariances."""
    known = np.isfinite(errors.nees)
    values = errors.nees[known]
    return EllipseCoverage(
        objects=len(np.unique(errors.object[known])),
        boxes=len(values),
        anees=float(values.mean() / 2) if len(values) else float("nan"),
        median_nees=float(np.median(values) / (2 * np.log(2))) if len(values) else float("nan"),
        coverage=coverages(values, tuple(BANDS)),
    )


def errors_by_class(errors: LabelErrors) -> dict[str, LabelErrors]:
    """The errors of each class with labels, preceded by those of all classes."""
    labels = np.unique(errors.label).tolist()
    return {OVERALL: errors, **{label: errors.select(errors.label == label) for label in labels}}

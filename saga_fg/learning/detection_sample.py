"""Sample of a sensor's detections, true and false, with their errors, and of the chances it had to detect objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, StrArray
from saga_fg.numerics.columns import Columns


@dataclass(frozen=True, eq=False)
class SampledDetections(Columns):
    """N detections; what is not known is NaN.

    label, logit         (N,)    class; logit of the detector's score
    range, azimuth       (N,)    from the sensor, m and rad from straight ahead
    true                 (N,)    whether it is of an object
    along, across        (N,)    error of the position along and across the line of sight, m
    velocity             (N, 2)  error, m/s
    yaw, height          (N,)    error, rad (half a turn counts as none) and m
    """

    label: StrArray
    logit: FloatArray
    range: FloatArray
    azimuth: FloatArray
    true: BoolArray
    along: FloatArray
    across: FloatArray
    velocity: FloatArray
    yaw: FloatArray
    height: FloatArray

    @classmethod
    def without_errors(
        cls, label: StrArray, logit: FloatArray, distance: FloatArray, azimuth: FloatArray, true: BoolArray
    ) -> SampledDetections:
        """Detections whose errors are not known."""
        nan = np.full(len(label), np.nan)
        return cls(label, logit, distance, azimuth, true, nan, nan, np.column_stack([nan, nan]), nan, nan)


@dataclass(frozen=True, eq=False)
class SampledObjects(Columns):
    """M objects in view of a frame: class, range (m) and azimuth (rad) from the sensor, whether it was detected."""

    label: StrArray
    range: FloatArray
    azimuth: FloatArray
    detected: BoolArray

    @classmethod
    def empty(cls) -> SampledObjects:
        return cls(np.empty(0, dtype=np.str_), np.empty(0), np.empty(0), np.empty(0, dtype=bool))


class DetectionSample(NamedTuple):
    """Detections of one sensor, and the objects that it could detect."""

    detections: SampledDetections
    objects: SampledObjects

    @classmethod
    def pool(cls, parts: Sequence[DetectionSample]) -> DetectionSample:
        """One sample of all parts, of which there is at least one."""
        detections, objects = zip(*parts, strict=True)
        return cls(SampledDetections.concatenate(detections), SampledObjects.concatenate(objects))

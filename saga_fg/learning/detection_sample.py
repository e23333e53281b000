"""What recordings show of a sensor: its detections, which of them were true, how far off, and what it overlooked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, StrArray

OF_OBJECTS = ("object_label", "object_range", "object_azimuth", "detected")


@dataclass(frozen=True, eq=False)
class DetectionSample:
    """N detections of one sensor, and M chances to detect an object.

    label, logit         (N,)    class; logit of the detector's score
    range, azimuth       (N,)    where the sensor saw it, m and rad from straight ahead
    true                 (N,)    whether it is of an object
    along, across        (N,)    error of the position along and across the line of sight, m
    velocity             (N, 2)  error, m/s
    yaw, height          (N,)    error, rad (half a turn counts as none) and m
    object_label         (M,)    class of an object that was there
    object_range, object_azimuth  (M,)    where, as above
    detected             (M,)    whether the sensor detected it

    What is not known is NaN.
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
    object_label: StrArray
    object_range: FloatArray
    object_azimuth: FloatArray
    detected: BoolArray

    @classmethod
    def empty(cls) -> Self:
        none = np.empty(0)
        no, text = none.astype(bool), np.empty(0, dtype="<U1")
        return cls(text, none, none, none, no, none, none, np.empty((0, 2)), none, none, text, none, none, no)

    @classmethod
    def of_detections(
        cls, label: StrArray, logit: FloatArray, distance: FloatArray, azimuth: FloatArray, true: BoolArray
    ) -> Self:
        """Detections (N,) whose errors are not known."""
        nan = np.full(len(label), np.nan)
        return replace(
            cls.empty(),
            label=label,
            logit=logit,
            range=distance,
            azimuth=azimuth,
            true=true,
            along=nan,
            across=nan,
            velocity=np.full((len(label), 2), np.nan),
            yaw=nan,
            height=nan,
        )

    @classmethod
    def of_objects(cls, label: StrArray, distance: FloatArray, azimuth: FloatArray, detected: BoolArray) -> Self:
        """Objects (M,) that were there to be seen."""
        return replace(
            cls.empty(), object_label=label, object_range=distance, object_azimuth=azimuth, detected=detected
        )

    @classmethod
    def pool(cls, parts: Sequence[DetectionSample]) -> Self:
        """All of them, in order."""
        if not parts:
            return cls.empty()
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))

    def of_class(self, label: str) -> DetectionSample:
        """What concerns one class."""
        return self.select(self.label == label, self.object_label == label)

    def select(self, detections: BoolArray, objects: BoolArray) -> DetectionSample:
        """Some detections (N,) and some objects (M,)."""
        columns = {field.name: getattr(self, field.name) for field in fields(self)}
        return DetectionSample(
            **{name: column[objects if name in OF_OBJECTS else detections] for name, column in columns.items()}
        )

    def __len__(self) -> int:
        return len(self.label)

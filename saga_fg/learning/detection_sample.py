"""What recordings show of a sensor: its detections, which of them were true, how far off, and what it overlooked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np

from saga_fg.arrays import BoolArray, FloatArray, StrArray


@dataclass(frozen=True, eq=False)
class DetectionSample:
    """N detections of one sensor, and M chances to detect an object.

    label, logit, range  (N,)    class; logit of the detector's score; distance from the sensor, m
    true                 (N,)    whether it is of an object
    along, across        (N,)    error of the position along and across the line of sight, m
    velocity             (N, 2)  error, m/s
    yaw, height          (N,)    error, rad (half a turn counts as none) and m
    object_label         (M,)    class of an object that was to be seen
    detected             (M,)    whether it was

    Errors that are not known are NaN.
    """

    label: StrArray
    logit: FloatArray
    range: FloatArray
    true: BoolArray
    along: FloatArray
    across: FloatArray
    velocity: FloatArray
    yaw: FloatArray
    height: FloatArray
    object_label: StrArray
    detected: BoolArray

    @classmethod
    def empty(cls) -> Self:
        none = np.empty(0)
        no, text = none.astype(bool), np.empty(0, dtype="<U1")
        return cls(text, none, none, no, none, none, np.empty((0, 2)), none, none, text, no)

    @classmethod
    def pool(cls, parts: Sequence[DetectionSample]) -> Self:
        """All of them, in order."""
        if not parts:
            return cls.empty()
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))

    def of_class(self, label: str) -> DetectionSample:
        """What concerns one class."""
        rows, objects = self.label == label, self.object_label == label
        columns = {field.name: getattr(self, field.name) for field in fields(self)}
        return DetectionSample(
            **{
                name: column[objects if name in ("object_label", "detected") else rows]
                for name, column in columns.items()
            }
        )

    def __len__(self) -> int:
        return len(self.label)

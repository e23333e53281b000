"""The labels of one moment: tracks, and the source and quality of each box."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, Self, get_args

import numpy as np

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, StrArray
from saga_fg.types.track import Tracks

Source = Literal["observed", "filled", "extended"]
"""Observed: the object was detected; filled: between detections; extended: before its online track or after it."""

Quality = Literal["high", "medium", "low"]
MEDIUM_SCORE = 0.2  # least score of a box of medium quality
HIGH_SCORE = 0.5  # least score of a box of high quality
HIGH_DEVIATION = 0.3  # largest standard deviation of the position of a box of high quality, m
MEDIUM_DEVIATION = 0.8  # likewise of a box of medium quality, m


@dataclass(frozen=True, eq=False)
class Labels:
    """The boxes of one moment.

    tracks    boxes (world), ids, scores and covariances; `coasting` is the time to the nearest detection, s
    yaw_variance (N,)  of the heading, rad^2; NaN where unknown
    source    (N,) observed, filled or extended
    quality   (N,) high, medium or low

    Raises `InputError` for columns of another length or other words.
    """

    tracks: Tracks
    yaw_variance: FloatArray
    source: StrArray
    quality: StrArray

    def __post_init__(self) -> None:
        for name, words in (("source", get_args(Source)), ("quality", get_args(Quality))):
            column = np.asarray(getattr(self, name), dtype=np.str_)
            if column.shape != (len(self.tracks),) or not np.isin(column, words).all():
                raise InputError(f"{name}: expected {len(self.tracks)} of {', '.join(words)}")
            object.__setattr__(self, name, column)
        if np.shape(self.yaw_variance) != (len(self.tracks),):
            raise InputError(f"yaw_variance: expected {len(self.tracks)} numbers")

    def __len__(self) -> int:
        return len(self.tracks)


@dataclass(frozen=True)
class LabelCounts:
    """Numbers of boxes of a recording that were observed, filled and extended, and dropped with their objects; of
    objects kept and dropped, and of tracklets stitched to another."""

    observed: int = 0
    filled: int = 0
    extended: int = 0
    dropped: int = 0
    objects: int = 0
    dropped_objects: int = 0
    joined: int = 0

    @property
    def boxes(self) -> int:
        """Boxes written."""
        return self.observed + self.filled + self.extended

    @classmethod
    def sum(cls, counts: Iterable[LabelCounts]) -> Self:
        """Add up several recordings."""
        parts = list(counts)
        return cls(*(sum(getattr(part, name) for part in parts) for name in cls.__dataclass_fields__))


def quality_of(score: FloatArray, covariance: FloatArray) -> StrArray:
    """(N,) the quality of boxes with these scores (N,) and position covariances (N, 2, 2), m^2."""
    deviation = np.sqrt(np.linalg.eigvalsh(covariance)[:, -1]) if len(score) else np.empty(0)
    high = (score >= HIGH_SCORE) & (deviation <= HIGH_DEVIATION)
    medium = (score >= MEDIUM_SCORE) & (deviation <= MEDIUM_DEVIATION)
    return np.where(high, "high", np.where(medium, "medium", "low"))

"""Detectors of landmarks: from a frame or a scan to observations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.frame import Frame
from saga_fg.types.landmark import Observation


class LandmarkDetector(Protocol):
    """Finds landmarks in the data of a moment: a frame, or the points (N, 3), m, of a scan in the scanner's frame."""

    def observations(self, seen: Frame | FloatArray) -> Sequence[Observation]:
        """Return what is observed: from a frame in the vehicle's coordinates, from points in theirs."""

"""Tracks at future times: `PredictedTracks`, the answer of `Tracker.predict`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray, checked

LONGEST = 60.0  # s; nobody knows where traffic is a minute later, and time runs out before


@dataclass(frozen=True, eq=False)
class PredictedTracks:
    """The N tracks of one moment at H future times, in world coordinates.

    timestamp            s, of the moment from which they are predicted
    horizons             (H,)          s after it, increasing
    id, label            (N,)          of the tracks
    position             (H, N, 2)     mean, m
    velocity             (H, N, 2)     mean, m/s
    yaw                  (H, N)        heading, rad; NaN where it is unknown
    position_covariance  (H, N, 2, 2)  m^2
    velocity_covariance  (H, N, 2, 2)  (m/s)^2
    joint_covariance     (H, 2N, 2N)   of all positions (x_1, y_1, x_2, ...), m^2; None unless it was asked for
    """

    timestamp: float
    horizons: FloatArray
    id: IntArray
    label: StrArray
    position: FloatArray
    velocity: FloatArray
    yaw: FloatArray
    position_covariance: FloatArray
    velocity_covariance: FloatArray
    joint_covariance: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.id)

    @property
    def times(self) -> FloatArray:
        """(H,) timestamps of the predictions, s."""
        return np.asarray(self.timestamp + self.horizons)


def checked_horizons(horizons: ArrayLike) -> FloatArray:
    """Return horizons (H,), s; raises `InputError` unless they are increasing, from 0 to `LONGEST`, one at least."""
    if np.ndim(horizons) == 0:
        raise InputError(f"horizons: expected a list of seconds, got {horizons!r:.40}")
    found = checked("horizons", horizons, (None,))
    if len(found) == 0 or found[0] < 0 or found[-1] > LONGEST or (np.diff(found) <= 0).any():
        raise InputError(
            f"horizons: expected increasing seconds from 0 to {LONGEST:g}, one at least, got {found.tolist()}"
        )
    return found

"""Whether the time of a frame is to be believed.

One frame with a broken time stamp must not take the tracker to another century, from where all that follows would be
late. So a frame further than `max_jump` from the newest one waits for a witness: when the next frame of its kind is
about as far away, the clock has really jumped.
"""

from __future__ import annotations

import math
from typing import Literal

Verdict = Literal["fits", "doubtful", "jumped ahead", "jumped back"]


class Clock:
    """Follows the time stamps of a stream."""

    def __init__(self, max_jump: float) -> None:
        self._max_jump = max_jump
        self.newest = -math.inf
        self._doubtful: float | None = None

    def judge(self, timestamp: float) -> Verdict:
        """What to make of the next frame's time, s. Only a doubtful one must not be used."""
        apart = timestamp - self.newest
        if not math.isfinite(apart) or abs(apart) <= self._max_jump:
            self._doubtful = None
            self.newest = max(self.newest, timestamp)
            return "fits"
        if self._doubtful is None or abs(timestamp - self._doubtful) > self._max_jump:
            self._doubtful = timestamp
            return "doubtful"
        self._doubtful = None
        self.newest = timestamp
        return "jumped ahead" if apart > 0 else "jumped back"

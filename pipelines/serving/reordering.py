"""Frames of several sensors, that arrive as they please, in order of time."""

from __future__ import annotations

import heapq
import math
from itertools import count
from typing import Generic, TypeVar

T = TypeVar("T")


class Reordering(Generic[T]):
    """Holds frames back until the newest one is `hold` s younger, and at most `max_held` of them.

    So no frame waits longer than it takes the stream to advance by `hold`, and memory is bounded; a frame that comes
    later still is passed on at once, and left to the tracker. So is a frame further than `max_jump` s from the newest
    one, after all that is held: the newest time stays until `set_clock` says that the clock was set.
    """

    def __init__(self, hold: float, max_held: int, max_jump: float = math.inf) -> None:
        self._hold, self._max_held, self._max_jump = hold, max_held, max(max_jump, hold)
        self._heap: list[tuple[float, int, T]] = []
        self._arrival = count()
        self.newest = -math.inf

    def __len__(self) -> int:
        return len(self._heap)

    def jumps(self, timestamp: float) -> bool:
        """Whether a time is too far from the newest one, s, to be believed at once."""
        return self.newest > -math.inf and abs(timestamp - self.newest) > self._max_jump

    def push(self, timestamp: float, item: T) -> list[T]:
        """Take in one; those whose turn has come, in order of time and, at one time, of arrival."""
        if self.jumps(timestamp):
            return [*self.flush(), item]
        self.newest = max(self.newest, timestamp)
        heapq.heappush(self._heap, (timestamp, next(self._arrival), item))
        due = []
        while self._heap and (self._heap[0][0] <= self.newest - self._hold or len(self._heap) > self._max_held):
            due.append(heapq.heappop(self._heap)[2])
        return due

    def flush(self) -> list[T]:
        """All that are held, in order of time."""
        return [heapq.heappop(self._heap)[2] for _ in range(len(self._heap))]

    def set_clock(self, timestamp: float) -> None:
        """Count as the newest time from now on, s; minus infinity for none."""
        self.newest = timestamp

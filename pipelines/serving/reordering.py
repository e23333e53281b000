"""Puts the frames of several sensors in order of time."""

from __future__ import annotations

import heapq
import math
from itertools import count
from typing import Generic, TypeVar

T = TypeVar("T")


class Reordering(Generic[T]):
    """Holds frames back until the newest one is `hold` s younger, and at most `max_held` of them.

    No frame waits longer than the stream takes to advance by `hold`. A frame that comes later still is passed on at
    once. So is a frame further than `max_jump` s from the newest one, after all held frames; the newest time then stays
    until `set_clock`.
    """

    def __init__(self, hold: float, max_held: int, max_jump: float = math.inf) -> None:
        self._hold, self._max_held, self._max_jump = hold, max_held, max(max_jump, hold)
        self._heap: list[tuple[float, int, T]] = []
        self._arrival = count()
        self.newest = -math.inf

    def __len__(self) -> int:
        return len(self._heap)

    def jumps(self, timestamp: float) -> bool:
        """Return True for a time, s, further than `max_jump` from the newest one."""
        return self.newest > -math.inf and abs(timestamp - self.newest) > self._max_jump

    def push(self, timestamp: float, item: T) -> list[T]:
        """Take in an item; return those whose turn has come, in order of time and, at one time, of arrival."""
        if self.jumps(timestamp):
            return [*self.flush(), item]
        self.newest = max(self.newest, timestamp)
        heapq.heappush(self._heap, (timestamp, next(self._arrival), item))
        due = []
        while self._heap and (self._heap[0][0] <= self.newest - self._hold or len(self._heap) > self._max_held):
            due.append(heapq.heappop(self._heap)[2])
        return due

    def flush(self) -> list[T]:
        """Release all items, in order of time."""
        return [heapq.heappop(self._heap)[2] for _ in range(len(self._heap))]

    def set_clock(self, timestamp: float) -> None:
        """Set the newest time, s; minus infinity for none."""
        self.newest = timestamp

"""Frames of several sensors, that arrive as they please, in order of time."""

from __future__ import annotations

import heapq
from itertools import count
from typing import Generic, TypeVar

T = TypeVar("T")


class Reordering(Generic[T]):
    """Holds frames back until the newest one is `hold` s younger, and at most `max_held` of them.

    So no frame waits longer than it takes the stream to advance by `hold`, and memory is bounded; a frame that comes
    later still is passed on at once, and left to the tracker.
    """

    def __init__(self, hold: float, max_held: int) -> None:
        self._hold, self._max_held = hold, max_held
        self._heap: list[tuple[float, int, T]] = []
        self._arrival = count()
        self._newest = float("-inf")

    def __len__(self) -> int:
        return len(self._heap)

    def push(self, timestamp: float, item: T) -> list[T]:
        """Take in one; those whose turn has come, in order of time and, at one time, of arrival."""
        self._newest = max(self._newest, timestamp)
        heapq.heappush(self._heap, (timestamp, next(self._arrival), item))
        due = []
        while self._heap and (self._heap[0][0] <= self._newest - self._hold or len(self._heap) > self._max_held):
            due.append(heapq.heappop(self._heap)[2])
        return due

    def flush(self) -> list[T]:
        """All that are held, in order of time; the newest time is forgotten."""
        due = [heapq.heappop(self._heap)[2] for _ in range(len(self._heap))]
        self._newest = float("-inf")
        return due

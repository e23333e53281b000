"""Limits how often a log line is repeated, so that a flood of messages is no flood of log lines."""

from __future__ import annotations

import logging
import time
from collections.abc import Hashable

MOST = 1000  # kinds that are remembered


class LogLimit:
    """Allows one log line of each kind of event in `seconds`."""

    def __init__(self, seconds: float = 60.0) -> None:
        self._seconds = seconds
        self._latest: dict[Hashable, float] = {}

    def due(self, kind: Hashable) -> bool:
        """Return True if an event of this kind may be logged now."""
        now = time.monotonic()
        if now - self._latest.get(kind, -self._seconds) < self._seconds:
            return False
        if len(self._latest) >= MOST:
            self._latest.clear()
        self._latest[kind] = now
        return True


class LogLimitFilter(logging.Filter):
    """Limits the log lines of every line of code."""

    def __init__(self) -> None:
        super().__init__()
        self._limit = LogLimit()

    def filter(self, record: logging.LogRecord) -> bool:
        """Return True if this record may be logged."""
        return self._limit.due((record.name, record.lineno))

"""Log lines that a flood of messages must not turn into a flood of their own."""

from __future__ import annotations

import logging
import time
from collections.abc import Hashable

MOST = 1000  # keys that are remembered


class Seldom:
    """Says of each kind of event whether it is time to log one again: once in `seconds`."""

    def __init__(self, seconds: float = 60.0) -> None:
        self._seconds = seconds
        self._latest: dict[Hashable, float] = {}

    def due(self, kind: Hashable) -> bool:
        """Whether to log an event of this kind."""
        now = time.monotonic()
        if now - self._latest.get(kind, -self._seconds) < self._seconds:
            return False
        if len(self._latest) >= MOST:
            self._latest.clear()
        self._latest[kind] = now
        return True


class SeldomFilter(logging.Filter):
    """Lets every line of code log once in a while only."""

    def __init__(self) -> None:
        super().__init__()
        self._seldom = Seldom()

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether this record is due."""
        return self._seldom.due((record.name, record.lineno))

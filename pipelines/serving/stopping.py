"""SIGINT and SIGTERM as a request to finish within a bounded time."""

from __future__ import annotations

import os
import queue
import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from types import FrameType, TracebackType
from typing import Self

SAVING = 1.0  # s


class StopRequest:
    """A context in which SIGINT and SIGTERM do not interrupt but request to stop; `number`: of the first signal.

    timeout  time to finish, s; then the process ends in spite of its other threads
    save     called before that end, for at most `SAVING` s
    clear    called last, to remove unfinished files
    """

    def __init__(
        self, timeout: float, save: Callable[[], object] = lambda: None, clear: Callable[[], object] = lambda: None
    ) -> None:
        self.number: int | None = None
        self._timeout = timeout
        self._save = save
        self._clear = clear
        self._callbacks: list[Callable[[], object]] = []
        self._requests: queue.SimpleQueue[int] = queue.SimpleQueue()  # a signal handler may put into this kind
        self._finished = threading.Event()
        self._before: dict[int, object] = {}

    def notify(self, callback: Callable[[], object]) -> None:
        """Call `callback` on a request to stop, in a signal handler; at once if there was one."""
        self._callbacks.append(callback)
        if self.number is not None:
            callback()

    def __enter__(self) -> Self:
        threading.Thread(target=self._watch, name="stop", daemon=True).start()
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._request)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._finished.set()
        self._requests.put(0)
        for number, before in self._before.items():
            signal.signal(number, before)  # type: ignore[arg-type]

    def _request(self, number: int, frame: FrameType | None) -> None:
        if self.number is None:
            self.number = number
            self._requests.put(number)
            for callback in self._callbacks:
                callback()

    def _watch(self) -> None:
        number = self._requests.get()
        if not self._finished.wait(self._timeout):
            saving = threading.Thread(target=self._save, daemon=True)
            with suppress(Exception):
                saving.start()
                saving.join(SAVING)
            with suppress(Exception):
                self._clear()
            os._exit(128 + number)

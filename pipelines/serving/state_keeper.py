"""Keeps the state of a stream in a file: restored at the start, written again and again by a thread of its own."""

from __future__ import annotations

import fcntl
import logging
import os
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from data_tools.files.atomic_files import check_writable, remove_leftovers
from pipelines.serving.log_limit import LogLimit
from pipelines.serving.state_file import read_state, write_state
from pipelines.serving.stream import StreamTracker
from saga_fg.errors import InputError

log = logging.getLogger(__name__)


class StateKeeper:
    """Writes the state of `stream` to `path` every `every` s in which something happened, and at the end.

    header: version, method and configuration; a file with another header is refused

    A lock beside the file, `.NAME.lock`, keeps other keepers away from `restore` to `stop`, and no longer than the
    process lives.

    The stream waits while its state is collected, not while it is written. A full disk is a warning, and shown in the
    stream's status; writing is tried again.
    """

    def __init__(self, stream: StreamTracker[Any], path: Path, every: float, header: Mapping[str, str]) -> None:
        self._stream = stream
        self._path = path
        self._every = every
        self._header = header
        self._writing = threading.Lock()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="state keeper", daemon=True)
        self._version = -1  # that is on the disk
        self._written_at: float | None = None
        self._log_limit = LogLimit()
        self._error: str | None = None
        self._lock: int | None = None

    def restore(self) -> bool:
        """Let the stream go on from the file; return False if there is none yet.

        Raises `InputError` for a damaged file, one of another configuration or of a service that runs, and for a place
        that is not writable.
        """
        check_writable(self._path)
        self._lock = _locked(self._path)
        there = self._path.exists()
        if there:
            try:
                state = read_state(self._path, self._header)
            except InputError:
                self.release()
                raise
            try:
                self._stream.restore(state)
            except Exception as error:  # of values that do not fit each other
                self.release()
                text = f"{self._path}: expected a state that fits: {type(error).__name__}: {error}"
                raise InputError(text) from error
            self._version = self._stream.version
        self._stream.keeper = self
        return there

    def start(self) -> None:
        """Begin to write."""
        self.clear_leftovers()
        self._thread.start()

    def stop(self) -> None:
        """Write a last time and end."""
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join()
        self.release()

    def release(self) -> None:
        """Release the lock."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def clear_leftovers(self) -> None:
        """Remove half-written files of a killed process."""
        remove_leftovers(self._path.parent, of=self._path.name)

    def save(self) -> bool:
        """Write the state unless it is on the disk already; return True if it is there now."""
        with self._writing:
            try:
                if self._stream.version == self._version:
                    return True
                state, durable, version = self._stream.state()
                write_state(self._path, self._header, state)
            except Exception as error:
                self._warn(error)
                return False
            self._version, self._written_at, self._error = version, time.monotonic(), None
            self._stream.made_durable(durable)
            return True

    def status(self) -> dict[str, Any]:
        """Return the age of the file in s (None: not written by this process) and the error of the latest attempt."""
        age = None if self._written_at is None else round(time.monotonic() - self._written_at, 3)
        return {"age": age, "error": self._error}

    def _run(self) -> None:
        while not self._stopping.wait(self._every):
            self.save()
        self.save()

    def _warn(self, error: Exception) -> None:
        self._error = " ".join(f"{error}".split())[:300]
        if self._log_limit.due(type(error).__name__):
            unexpected = None if isinstance(error, InputError | OSError) else error
            log.warning("the state is not kept: %s", self._error, exc_info=unexpected)


def _locked(path: Path) -> int:
    """Lock a state file; return the descriptor that holds the lock. Raises `InputError` if another process does."""
    final = path.resolve()
    try:
        lock = os.open(final.with_name(f".{final.name}.lock"), os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        raise InputError(f"{path}: expected a place for a lock beside it: {error.strerror or error}") from error
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(lock)
        if isinstance(error, BlockingIOError):
            raise InputError(f"{path}: another service keeps its state in this file") from error
        raise InputError(f"{path}: expected a file system with locks: {error.strerror or error}") from error
    return lock

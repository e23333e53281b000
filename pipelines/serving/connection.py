"""One client of a service on a socket: its lines in, its answers out, within limits and without waiting for it."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Iterable
from typing import Protocol, cast

from pipelines.serving.lines import LineSplitter
from pipelines.serving.messages import encode
from pipelines.serving.settings import StreamSettings

log = logging.getLogger(__name__)

LONG = 2**16  # bytes; frames of a few hundred objects have fewer
LINE_COST = 64  # bytes that a waiting line takes besides its text


class Host(Protocol):
    """The server, as its connections see it."""

    settings: StreamSettings

    def connected(self, client: Connection) -> None:
        """It is there."""

    def resized(self, difference: int) -> None:
        """It holds so many bytes more."""

    def arrived(self, client: Connection) -> None:
        """It has sent something, or ended."""

    def lost(self, client: Connection) -> None:
        """It is gone."""

    def dropped(self, client: Connection, reason: str, text: str) -> None:
        """It is closed for a reason, which `text` explains."""


class Connection(asyncio.Protocol):
    """Lines wait in `lines` with the time they came; answers wait in the transport, up to `max_outbox`.

    hears_all  whether it has subscribed to all tracks
    ended      whether it will send no more
    queued     whether it waits for its turn
    working    whether one of its lines is being worked on
    size       bytes of what it has sent and nobody has worked on
    """

    def __init__(self, host: Host) -> None:
        self.name = "client"
        self.lines: deque[tuple[bytes | None, float]] = deque()
        self.hears_all = self.ended = self.queued = self.working = False
        self.size = 0
        self.active = time.monotonic()
        self._host = host
        self._splitter = LineSplitter(host.settings.max_message)
        self._waiting = 0  # bytes in `lines`
        self._closing = self._full = self._lost = self._stopped = False
        self._sent = 0
        self._progress = (0, 0.0)  # bytes that have left, and since when
        self._transport: asyncio.Transport

    @property
    def long_line_next(self) -> bool:
        """Whether the line that has waited longest is long."""
        return bool(self.lines) and len(self.lines[0][0] or b"") > LONG

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        self._host.connected(self)

    def data_received(self, data: bytes) -> None:
        if self._closing:
            return
        self.active = time.monotonic()
        self._append(self._splitter.feed(data))

    def eof_received(self) -> bool:
        self.ended = True
        self._append(self._splitter.finish())
        return True  # answers may still be on the way

    def connection_lost(self, exc: Exception | None) -> None:
        log.info("%s: gone: %s", self.name, exc or "closed")
        self._closing = self._lost = self.ended = True  # what it has sent counts
        self._splitter.clear()
        self._resize()
        self._host.lost(self)

    def pause_writing(self) -> None:
        self._full = True
        self._progress = (self._delivered, time.monotonic())
        self.regulate()
        self._watch()

    def resume_writing(self) -> None:
        self._full = False
        self.regulate()

    def next_line(self) -> tuple[bytes | None, float]:
        """Take out the line that has waited longest."""
        line, received = self.lines.popleft()
        self._waiting -= LINE_COST + len(line or b"")
        self._resize()
        self.regulate()
        return line, received

    def send(self, line: bytes) -> None:
        """Send a line, now or when the client reads on."""
        if self._closing:
            return
        if self._transport.get_write_buffer_size() + len(line) > self._host.settings.max_outbox:
            self._give_up()
            return
        self.active = time.monotonic()
        self._sent += len(line)
        self._transport.write(line)

    def refuse(self, reason: str, text: str) -> None:
        """Tell the client why, and close; what it has sent is forgotten."""
        self._host.dropped(self, reason, text)
        self.lines.clear()
        self._waiting = 0
        self.send(encode({"type": "error", "message": f"{text}: the connection is closed"}))
        self.close()

    def close(self) -> None:
        """Close once the client has read its answers."""
        if not self._closing:
            self._closing = self.ended = True
            self._splitter.clear()
            self._resize()
            self._progress = (self._delivered, time.monotonic())
            self._transport.close()
            self._watch()

    def regulate(self) -> None:
        """Read on, or let the client wait while enough of its lines do, or its answers."""
        settings = self._host.settings
        wanted = len(self.lines) < settings.max_queue and self._waiting <= settings.max_message and not self._full
        if self._closing or self._stopped or self.ended:
            return
        if wanted:
            self._transport.resume_reading()
        else:
            self._transport.pause_reading()

    def stop_reading(self) -> None:
        """Take in no more."""
        self._stopped = True
        if not self._closing:
            self._transport.pause_reading()

    def _append(self, lines: Iterable[bytes | None]) -> None:
        now = time.monotonic()
        for line in lines:
            self.lines.append((line, now))
            self._waiting += LINE_COST + len(line or b"")
        self._resize()
        self.regulate()
        self._host.arrived(self)

    def _resize(self) -> None:
        before, self.size = self.size, len(self._splitter) + self._waiting
        self._host.resized(self.size - before)

    @property
    def _delivered(self) -> int:
        return self._sent - self._transport.get_write_buffer_size()

    def _watch(self) -> None:
        asyncio.get_running_loop().call_later(self._host.settings.client_timeout / 4, self._look)

    def _look(self) -> None:
        """Give up a client that makes no progress while its answers pile up, or while it is being closed."""
        if not (self._full or self._closing) or self._lost:
            return
        now, delivered = time.monotonic(), self._delivered
        if delivered > self._progress[0]:
            self._progress = (delivered, now)
        elif now - self._progress[1] >= self._host.settings.client_timeout:
            self._give_up()
            return
        self._watch()

    def _give_up(self) -> None:
        self._host.dropped(self, "slow", "does not read its answers")
        self._closing = True
        self._transport.abort()

"""A service on standard input and output: one client, one line at a time."""

from __future__ import annotations

import logging
import os
import select
from collections.abc import Iterable
from typing import IO, Any

from pipelines.serving.messages import LineSplitter, encode
from pipelines.serving.stopping import StopRequest
from pipelines.serving.stream import StreamTracker

log = logging.getLogger(__name__)

PIECE = 2**16  # bytes read at once


def serve_pipe(
    stream: StreamTracker[None], source: IO[bytes], sink: IO[bytes], stop: StopRequest | None = None
) -> None:
    """Answer lines until the source ends or `stop` is requested, then the frames that are held back.

    source: a file with a descriptor; nothing may have been read from its buffer. A slow reader of the answers slows the
    reading: nothing piles up. Raises `BrokenPipeError` when that reader goes away.
    """

    def send(answers: Iterable[tuple[None, dict[str, Any]]]) -> None:
        for _, answer in answers:
            sink.write(encode(answer))
        sink.flush()

    splitter, descriptor = LineSplitter(stream.settings.max_message), source.fileno()
    stopped, wake = os.pipe()  # stays open: a signal may come at any time
    if stop is not None:
        stop.notify(lambda: os.write(wake, b"."))
    ended = False
    while not ended:
        ready, _, _ = select.select([descriptor, stopped], [], [])
        ended = stopped in ready
        if descriptor in ready:
            piece = _read(descriptor)
            ended |= not piece
            for line in splitter.feed(piece) if piece else splitter.finish():
                send(stream.handle(line, None))
    send(stream.flush())


def _read(descriptor: int) -> bytes:
    """The next bytes, none at the end or where they cannot be read."""
    try:
        return os.read(descriptor, PIECE)
    except OSError as error:
        log.warning("standard input: %s", error)
        return b""

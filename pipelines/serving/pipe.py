"""A service on standard input and output: one client, one line at a time."""

from __future__ import annotations

import logging
import queue
import threading
from typing import IO

from pipelines.serving.lines import LineSplitter
from pipelines.serving.messages import encode
from pipelines.serving.stopping import StopRequest
from pipelines.serving.stream import StreamTracker

log = logging.getLogger(__name__)

PIECE = 2**16  # bytes read at once


class _End:
    """Stands after the last line."""


def serve_pipe(
    stream: StreamTracker[None], source: IO[bytes], sink: IO[bytes], stop: StopRequest | None = None
) -> None:
    """Answer lines until the source ends or `stop` is asked for; what is held back is taken in then.

    Whoever reads the answers slowly slows the reading: nothing piles up. Raises `BrokenPipeError` when he goes away.
    """
    lines: queue.SimpleQueue[bytes | _End | None] = queue.SimpleQueue()
    room = threading.Semaphore(stream.settings.max_queue)
    threading.Thread(target=_read, args=(source, stream.settings.max_message, lines, room), daemon=True).start()
    if stop is not None:
        stop.notify(lambda: lines.put(_End()))
    while not isinstance(line := lines.get(), _End):
        for _, answer in stream.handle(line, None):
            sink.write(encode(answer))
        sink.flush()
        room.release()
    for _, answer in stream.flush():
        sink.write(encode(answer))
    sink.flush()


def _read(
    source: IO[bytes], limit: int, lines: queue.SimpleQueue[bytes | _End | None], room: threading.Semaphore
) -> None:
    """All lines of a source; waits while there is no room."""
    splitter = LineSplitter(limit)
    unbuffered = getattr(source, "raw", source)  # a thread that waits in a buffered file cannot be left behind
    try:
        while piece := unbuffered.read(PIECE):
            for line in splitter.feed(piece):
                room.acquire()
                lines.put(line)
        for line in splitter.finish():
            lines.put(line)
    except OSError as error:
        log.warning("standard input: %s", error)
    finally:
        lines.put(_End())

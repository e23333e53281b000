"""A service on standard input and output: one client, one line at a time."""

from __future__ import annotations

from typing import IO

from pipelines.serving.messages import encode
from pipelines.serving.stream import StreamTracker
from saga_fg.errors import InputError


def serve_pipe(stream: StreamTracker[None], source: IO[bytes], sink: IO[bytes]) -> None:
    """Answer lines until the source ends or an interrupt comes; what is held back is taken in then.

    Whoever reads the answers slowly slows the reading: nothing piles up. Raises `BrokenPipeError` when he goes away.
    """
    limit = stream.settings.max_message
    try:
        while line := source.readline(limit + 1):
            if len(line) > limit and not line.endswith(b"\n"):
                _skip_line(source, limit)
                answer = stream.refused(InputError(f"message: expected at most {limit} bytes"))
                sink.write(encode(answer))
            else:
                for _, answer in stream.handle(line, None):
                    sink.write(encode(answer))
            sink.flush()
    except KeyboardInterrupt:
        pass
    for _, answer in stream.flush():
        sink.write(encode(answer))
    sink.flush()


def _skip_line(source: IO[bytes], limit: int) -> None:
    while rest := source.readline(limit):
        if rest.endswith(b"\n"):
            return

"""Lines out of the pieces in which they arrive."""

from __future__ import annotations

from collections.abc import Iterator


class LineSplitter:
    """Joins pieces into lines of at most `limit` bytes. A longer one comes out as None, and is not kept meanwhile."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._unfinished = bytearray()
        self._too_long = False

    def __len__(self) -> int:
        """Bytes of the unfinished line."""
        return len(self._unfinished)

    def feed(self, piece: bytes) -> Iterator[bytes | None]:
        """Take in the next piece; the lines that end in it, without empty ones."""
        *ends, rest = piece.split(b"\n")
        for end in ends:
            self._add(end)
            yield from self.finish()
        self._add(rest)

    def finish(self) -> Iterator[bytes | None]:
        """The unfinished line, if there is one: at the end of all pieces."""
        line = None if self._too_long else bytes(self._unfinished)
        self._unfinished, self._too_long = bytearray(), False
        if line is None or line.strip():
            yield line

    def clear(self) -> None:
        """Forget the unfinished line."""
        self._unfinished = bytearray()

    def _add(self, part: bytes) -> None:
        if self._too_long or len(self._unfinished) + len(part) > self._limit:
            self._unfinished, self._too_long = bytearray(), True
        else:
            self._unfinished += part

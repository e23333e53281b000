"""A small client of the service, for Python programs and for `saga-fg status`."""

import json
import socket
import time
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self

from pipelines.serving.messages import encode
from pipelines.serving.settings import Address
from saga_fg.errors import InputError


class StreamClient:
    """A connection to a service; a context manager.

    Raises `InputError` where no service listens, and `ConnectionError` when the service goes away.
    """

    def __init__(self, address: Address, timeout: float | None = 30.0) -> None:
        family = (
            socket.AF_UNIX if address.path is not None else socket.AF_INET6 if ":" in address.host else socket.AF_INET
        )
        self._address = address
        self._socket = socket.socket(family)
        self._socket.settimeout(timeout)
        try:
            self._connect(timeout)
        except OSError as error:
            self._socket.close()
            raise InputError(f"{address}: nobody answers there: {error.strerror or error}") from error
        self._lines = self._socket.makefile("rb")

    def _connect(self, timeout: float | None) -> None:
        where = str(self._address.path) if self._address.path is not None else (self._address.host, self._address.port)
        end = time.monotonic() + (timeout or 0.0)
        while True:
            try:
                return self._socket.connect(where)
            except BlockingIOError:  # as many others wait to be accepted at this Unix socket as may
                if time.monotonic() > end:
                    raise
                time.sleep(0.01)

    def send(self, message: Mapping[str, Any] | bytes) -> None:
        """Send one message, or a raw line."""
        self._socket.sendall(message if isinstance(message, bytes) else encode(message))

    def receive(self) -> dict[str, Any]:
        """Return the next answer. Raises `InputError` for a line that is no JSON object."""
        line = self._lines.readline()
        if not line:
            raise ConnectionError("the service has closed the connection")
        try:
            answer = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise InputError(f"{self._address}: expected an answer in JSON, got {line[:80]!r}") from error
        if not isinstance(answer, dict):
            raise InputError(f"{self._address}: expected an object as answer, got {line[:80]!r}")
        return answer

    def ask(self, message: Mapping[str, Any]) -> dict[str, Any]:
        """Send one message; return the next answer."""
        self.send(message)
        return self.receive()

    def close(self) -> None:
        """Close the connection."""
        self._lines.close()
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

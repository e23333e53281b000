"""The address and the limits of a service, of its log lines as well."""

import ipaddress
import logging
import time
from collections.abc import Hashable
from dataclasses import dataclass
from pathlib import Path

from saga_fg.errors import InputError
from saga_fg.settings import (
    NonNegative,
    Positive,
    PositiveInt,
    PositiveOrInf,
    Settings,
    setting,
)

MB = 2**20


@dataclass(frozen=True)
class StreamSettings(Settings):
    """Limits of a stream and of its connections. `reorder` counts on the frames' clock, other times on the wall's."""

    reorder: NonNegative = setting(
        0.0, "hold frames back this long to sort those of several sensors by time, s; 0: never; higher: more delay"
    )
    max_sensors: PositiveInt = setting(
        1000, "largest number of sensors whose frames are numbered; beyond it the longest silent one is forgotten"
    )
    max_detections: PositiveInt = setting(
        500, "largest number of detections of a frame; 500 take up to 0.2 s, for which all clients wait"
    )
    max_message: PositiveInt = setting(4 * MB, "largest size of a message, bytes")
    max_failures: PositiveInt = setting(3, "internal errors in a row after which a fresh tracker starts")
    max_clients: PositiveInt = setting(
        256, "largest number of connections; fewer where the process may open fewer files"
    )
    max_outbox: PositiveInt = setting(
        8 * MB, "largest size of unread answers of a client, bytes; beyond it the client is closed"
    )
    client_timeout: Positive = setting(
        0.5, "time after which a client that reads none of its waiting answers is closed, s"
    )
    idle_timeout: PositiveOrInf = setting(
        3600.0, "time without messages and answers after which a client is closed, s; .inf: never"
    )
    stop_timeout: Positive = setting(
        5.0, "time to finish after SIGTERM or SIGINT, after which the process ends in any case, s"
    )


@dataclass(frozen=True)
class Address:
    """A TCP port, `host` and `port` (0: any free one), or the `path` of a Unix socket."""

    host: str = ""
    port: int = 0
    path: Path | None = None

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return str(self.path) if self.path is not None else f"{host}:{self.port}"

    @property
    def is_local(self) -> bool:
        """True if only this machine can reach it."""
        if self.path is not None or self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False


def parse_address(text: str) -> Address:
    """Read `HOST:PORT`, `[IPV6]:PORT`, `:PORT` (this machine) or the path of a Unix socket, which holds a slash."""
    if "/" in text:
        return Address(path=Path(text))
    host, colon, port = text.rpartition(":")
    if not colon or not port.isascii() or not port.isdecimal() or len(port) > 5 or int(port) > 65535:
        raise InputError(f"{text}: expected HOST:PORT, or a path with a slash for a Unix socket")
    return Address(host.strip("[]") or "127.0.0.1", int(port))


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
    """Limits the log lines of every line of code, for each `kind` of their records."""

    def __init__(self) -> None:
        super().__init__()
        self._limit = LogLimit()

    def filter(self, record: logging.LogRecord) -> bool:
        """Return True if this record may be logged."""
        return self._limit.due((record.name, record.lineno, getattr(record, "kind", None)))

"""The address of a service, and its limits: how it treats time, how much it takes in, and how long it waits."""

from __future__ import annotations

import ipaddress
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
        0.0, "s a frame is held back, so that frames of several sensors go in in order of time"
    )
    max_held: PositiveInt = setting(256, "frames held back at most; beyond, the oldest goes in")
    max_sensors: PositiveInt = setting(
        1000, "sensors whose frames are numbered at most; beyond, the one silent for longest loses its number"
    )
    max_seq_jump: PositiveInt = setting(
        1_000_000, "a `seq` further than this beyond the last one of its sensor is refused; the first may be any"
    )
    max_detections: PositiveInt = setting(
        500, "detections of a frame at most; one frame of so many takes up to 0.2 s, for which all clients wait"
    )
    max_message: PositiveInt = setting(4 * MB, "bytes of a message at most")
    max_failures: PositiveInt = setting(3, "internal errors of the tracker in a row that start a fresh tracker")
    max_clients: PositiveInt = setting(256, "connections at most, fewer where the process may not open as many files")
    max_unfinished: PositiveInt = setting(
        64 * MB, "bytes of unfinished and waiting lines of all clients; beyond, the client that holds most is closed"
    )
    max_outbox: PositiveInt = setting(
        8 * MB, "bytes of answers that wait for one client to read them; beyond, it is closed"
    )
    client_timeout: Positive = setting(
        0.5, "a client whose answers pile up and that reads nothing for this long is closed, s"
    )
    idle_timeout: PositiveOrInf = setting(3600.0, "a client without a message or an answer for this long is closed, s")
    stop_timeout: Positive = setting(
        5.0, "time to finish after SIGTERM or SIGINT; then the process ends all the same, s"
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
    if not colon or not port.isascii() or not port.isdigit() or int(port) > 65535:
        raise InputError(f"{text}: expected HOST:PORT, or a path with a slash for a Unix socket")
    return Address(host.strip("[]") or "127.0.0.1", int(port))

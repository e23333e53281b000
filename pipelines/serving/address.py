"""Where a service listens: a TCP port or a Unix socket."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from pathlib import Path

from saga_fg.errors import InputError


@dataclass(frozen=True)
class Address:
    """Either `path` of a Unix socket, or `host` and `port` (0: any free one)."""

    host: str = ""
    port: int = 0
    path: Path | None = None

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return str(self.path) if self.path is not None else f"{host}:{self.port}"

    @property
    def is_local(self) -> bool:
        """Whether only this machine can reach it."""
        if self.path is not None or self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False


def parse_address(text: str) -> Address:
    """`HOST:PORT`, `[IPV6]:PORT`, `:PORT` (this machine) or the path of a Unix socket, which holds a slash."""
    if "/" in text:
        return Address(path=Path(text))
    host, colon, port = text.rpartition(":")
    if not colon or not port.isascii() or not port.isdigit() or int(port) > 65535:
        raise InputError(f"{text}: expected HOST:PORT, or a path with a slash for a Unix socket")
    return Address(host.strip("[]") or "127.0.0.1", int(port))

"""Opening input files, which must be regular files.

A device may be endless, and a pipe without a writer blocks: both are refused before a byte is read.
"""

from __future__ import annotations

import io
import os
import stat
from pathlib import Path
from typing import TextIO

from saga_fg.errors import InputError

_COMPRESSED = {
    b"BZh": "bzip2",
    b"\x1f\x8b": "gzip",
    b"PK\x03\x04": "zip",
    b"\xfd7zXZ": "xz",
    b"\x28\xb5\x2f\xfd": "zstd",
}
_FLAGS = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0) | getattr(os, "O_BINARY", 0)


def open_bytes(path: str | Path) -> io.BufferedReader:
    """Open a file to read bytes. Raises `InputError` naming it if it cannot be opened or is no regular file."""
    try:
        descriptor = os.open(path, _FLAGS)
    except (OSError, ValueError) as error:  # ValueError: a name with a zero byte
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        kind = "a folder" if stat.S_ISDIR(mode) else "a pipe" if stat.S_ISFIFO(mode) else "a device"
        raise InputError(f"{path}: cannot be read: expected a regular file, this is {kind}")
    return os.fdopen(descriptor, "rb")


def open_text(path: str | Path, encoding: str = "utf-8", newline: str | None = None) -> TextIO:
    """Open a file to read text. Raises `InputError` as `open_bytes` does."""
    return io.TextIOWrapper(open_bytes(path), encoding=encoding, newline=newline)


def read_bytes(path: str | Path) -> bytes:
    """Read a whole file. Raises `InputError` as `open_bytes` does."""
    try:
        with open_bytes(path) as file:
            return file.read()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error


def read_text(path: str | Path) -> str:
    """Read a whole text file in UTF-8. Raises `InputError` as `open_bytes` does, and for what is no such text."""
    content = read_bytes(path)
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        packed = next((name for start, name in _COMPRESSED.items() if content.startswith(start)), None)
        got = (
            f"a file compressed by {packed}, to be decompressed first"
            if packed
            else "bytes that are none: another encoding, or no text"
        )
        raise InputError(f"{path}: expected text in UTF-8, got {got}") from error

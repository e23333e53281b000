"""Readers that a child process runs in the tests: good ones, and ones that a damaged file has taken over."""

from __future__ import annotations

import ctypes
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

from saga_fg.errors import InputError, MissingExtraError


def numbers(_: object, n: int) -> Iterator[int]:
    yield from range(n)


def process(_: object) -> Iterator[int]:
    yield os.getpid()


def lines(path: Path) -> Iterator[str]:
    yield from path.read_text().splitlines()


def environment(_: object) -> Iterator[tuple[str, str]]:
    yield os.environ["OPENBLAS_NUM_THREADS"], str(Path.cwd())


def spins(_: object) -> Iterator[int]:
    yield 1
    while True:
        pass


def sleeps(_: object) -> Iterator[int]:
    yield os.getpid()
    time.sleep(1000)


def crashes(_: object) -> Iterator[int]:
    yield 1
    ctypes.string_at(0)


def exits(_: object) -> Iterator[int]:
    yield 1
    os._exit(3)


def grows(_: object) -> Iterator[bytes]:
    yield bytes(10**13)


def floods(_: object) -> Iterator[bytes]:
    while True:
        yield bytes(10**6)


def refuses(path: object) -> Iterator[int]:
    yield 1
    raise InputError(f"{path}: line 7: expected a number")


def lacks(path: object) -> Iterator[int]:
    raise MissingExtraError(f"{path}: needs more")
    yield 1


def fails(path: object) -> Iterator[int]:
    yield 1
    raise KeyError("a\nb")


def connects(_: object, host: str, port: int) -> Iterator[bytes]:
    with socket.create_connection((host, port), timeout=5) as there:
        yield there.recv(5)

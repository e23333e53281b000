"""Hostile clients of a service, in a process of their own.

Lines on standard input say how far the good clients are, from 0 to 1; the attack goes as far and ends with them. The
number of messages sent is printed at the end.
"""

from __future__ import annotations

import select
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np

from pipelines.bench.hostile_messages import EPOCH, hostile_line
from pipelines.serving import Address
from saga_fg.errors import SagaError

CLIENTS = 4
UNFINISHED = 0.01  # share of lines whose client leaves in the middle
RUDE = 0.2  # share of connections that read no answers
MESSAGES_OF_A_CONNECTION = 100


class Attack:
    """Starts the process. seconds: how long the good clients' clocks run."""

    def __init__(self, address: Address, seed: int, messages: int, seconds: float) -> None:
        command = [sys.executable, "-m", "pipelines.bench.attack", *map(str, (address, seed, messages, seconds))]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def go_on(self, done: float) -> None:
        """The good clients are as far, 0 to 1. Raises `SagaError` when the process has failed."""
        assert self._process.stdin is not None
        try:
            print(done, file=self._process.stdin, flush=True)
        except OSError as error:
            raise SagaError("the hostile clients have gone away") from error

    def end(self) -> int:
        """Wait for the last message; how many were sent."""
        sent, _ = self._process.communicate(f"{1.0}\n")
        if self._process.returncode != 0:
            raise SagaError("the hostile clients have failed")
        return int(sent)

    def kill(self) -> None:
        """At once."""
        self._process.kill()
        self._process.communicate()


class _Progress:
    """How far the good clients are; 1 when nobody says so any more."""

    def __init__(self) -> None:
        self.done = 0.0
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in sys.stdin:
            self.done = float(line)
        self.done = 1.0


def _main(path: str, seed: str, messages: str, seconds: str) -> None:
    progress, share = _Progress(), -(-int(messages) // CLIENTS)
    threads = [
        threading.Thread(target=_send, args=(Address(path=Path(path)), int(seed) + k, share, progress, float(seconds)))
        for k in range(CLIENTS)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    print(share * CLIENTS)


def _send(address: Address, seed: int, messages: int, progress: _Progress, seconds: float) -> None:
    rng = np.random.default_rng([seed, 7])
    sent = 0
    while sent < messages:
        try:
            with _connected(address) as client:
                reads, count = rng.random() >= RUDE, int(rng.integers(1, 2 * MESSAGES_OF_A_CONNECTION))
                for _ in range(min(count, messages - sent)):
                    while sent > progress.done * messages:
                        time.sleep(0.005)
                    line = hostile_line(rng, EPOCH + seconds * progress.done)
                    sent += 1
                    if rng.random() < UNFINISHED:
                        client.sendall(line[: len(line) // 2])
                        break
                    client.sendall(line + b"\n")
                    if reads:
                        _discard(client)
        except OSError:  # closed by the service, or the service is being started again
            time.sleep(0.02)


def _connected(address: Address) -> socket.socket:
    client = socket.socket(socket.AF_UNIX)
    client.settimeout(5.0)
    try:
        client.connect(str(address.path))
    except OSError:
        client.close()
        raise
    return client


def _discard(client: socket.socket) -> None:
    """Read what answers are there."""
    while select.select([client], [], [], 0.0)[0]:
        if not client.recv(2**16):
            raise ConnectionError


if __name__ == "__main__":
    _main(*sys.argv[1:])

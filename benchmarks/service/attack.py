"""Hostile clients of a service, in a process of their own, which keep pace with the good clients."""

from __future__ import annotations

import os
import select
import socket
import threading
import time
from multiprocessing import get_context, parent_process
from typing import Any

import numpy as np

from benchmarks.service.hostile_messages import EPOCH, hostile_line
from pipelines.serving import Address
from saga_fg.errors import SagaError

CLIENTS = 4
UNFINISHED = 0.01  # share of lines whose client leaves in the middle
RUDE = 0.2  # share of connections that read no answers
MESSAGES_OF_A_CONNECTION = 100


class Attack:
    """Starts the process. seconds: duration of the good clients' clocks."""

    def __init__(self, address: Address, seed: int, messages: int, seconds: float) -> None:
        context = get_context("spawn")
        self._share = -(-messages // CLIENTS)
        self._done = context.Value("d", 0.0)
        arguments = (address, seed, self._share, seconds, self._done)
        self._process = context.Process(target=_attack, args=arguments, daemon=True)
        self._process.start()

    def go_on(self, done: float) -> None:
        """Send up to this share of the messages, 0 to 1. Raises `SagaError` when the process has failed."""
        if self._process.exitcode:
            raise SagaError("the hostile clients have failed")
        self._done.value = done

    def end(self) -> int:
        """Wait for the last message; returns the number of messages."""
        self.go_on(1.0)
        self._process.join()
        self.go_on(1.0)
        return self._share * CLIENTS

    def kill(self) -> None:
        """End the process at once."""
        self._process.kill()
        self._process.join()


def _attack(address: Address, seed: int, share: int, seconds: float, done: Any) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    threads = [threading.Thread(target=_send, args=(address, seed + k, share, seconds, done)) for k in range(CLIENTS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _send(address: Address, seed: int, messages: int, seconds: float, done: Any) -> None:
    rng = np.random.default_rng([seed, 7])
    sent = 0
    while sent < messages:
        try:
            with _connected(address) as client:
                reads, count = rng.random() >= RUDE, int(rng.integers(1, 2 * MESSAGES_OF_A_CONNECTION))
                for _ in range(min(count, messages - sent)):
                    while sent > done.value * messages:
                        time.sleep(0.005)
                    line = hostile_line(rng, EPOCH + seconds * done.value)
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
    """Read the answers that are there."""
    while select.select([client], [], [], 0.0)[0]:
        if not client.recv(2**16):
            raise ConnectionError

"""Hostile clients of a service, two hundred at a time, in a process of their own that keeps pace with the good ones."""

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

THREADS, CONNECTED = 4, 50  # together 200 clients at a time
UNFINISHED = 0.01  # share of lines whose client leaves in the middle
RUDE = 0.2  # share of connections that read no answers
MESSAGES_OF_A_CONNECTION = 100
PATIENCE = 60.0  # s for all to connect


class Attack:
    """Starts the process, and waits until its clients are connected. seconds: duration of the good clients' clocks."""

    def __init__(self, address: Address, seed: int, messages: int, seconds: float) -> None:
        context = get_context("spawn")
        self._share = -(-messages // THREADS)
        self._done, connected = context.Value("d", 0.0), context.Semaphore(0)
        arguments = (address, seed, self._share, seconds, self._done, connected)
        self._process = context.Process(target=_attack, args=arguments, daemon=True)
        self._process.start()
        if not all(connected.acquire(timeout=PATIENCE) for _ in range(THREADS)):
            self.kill()
            raise SagaError("the hostile clients cannot connect")

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
        return self._share * THREADS

    def kill(self) -> None:
        """End the process at once."""
        self._process.kill()
        self._process.join()


def _attack(address: Address, seed: int, share: int, seconds: float, done: Any, connected: Any) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    threads = [
        threading.Thread(target=_send, args=(address, seed + k, share, seconds, done, connected))
        for k in range(THREADS)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


class _Client:
    """A connection, for so many lines; it may read no answers."""

    def __init__(self, address: Address, rng: np.random.Generator) -> None:
        self.socket = _connected(address)
        self.reads, self.left = rng.random() >= RUDE, int(rng.integers(1, 2 * MESSAGES_OF_A_CONNECTION))

    def send(self, line: bytes, whole: bool) -> None:
        """Send one, or half of it as the last one."""
        self.left = self.left - 1 if whole else 0
        self.socket.sendall(line + b"\n" if whole else line[: len(line) // 2])
        if self.reads:
            _discard(self.socket)


def _send(address: Address, seed: int, messages: int, seconds: float, done: Any, connected: Any) -> None:
    """Send so many lines, each by one of the connections; one that is done or closed is made anew."""
    rng = np.random.default_rng([seed, 7])
    clients = [_Client(address, rng) for _ in range(CONNECTED)]
    connected.release()
    for sent in range(messages):
        while sent >= done.value * messages:
            time.sleep(0.005)
        line, k = hostile_line(rng, EPOCH + seconds * done.value), int(rng.integers(CONNECTED))
        try:
            clients[k].send(line, whole=rng.random() >= UNFINISHED)
        except OSError:  # closed by the service
            clients[k].left = 0
        if not clients[k].left:
            clients[k].socket.close()
            clients[k] = _Client(address, rng)


def _connected(address: Address) -> socket.socket:
    """A connection; waits while nobody listens, since the service is being started again."""
    while True:
        client = socket.socket(socket.AF_UNIX)
        client.settimeout(5.0)
        try:
            client.connect(str(address.path))
        except OSError:
            client.close()
            time.sleep(0.02)
        else:
            return client


def _discard(client: socket.socket) -> None:
    """Read the answers that are there."""
    while select.select([client], [], [], 0.0)[0]:
        if not client.recv(2**16):
            raise ConnectionError

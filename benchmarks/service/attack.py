"""Hostile clients of a service, two hundred at a time, in a process of their own that keeps pace with the good ones.

Messages that no sensor should send: one line each, with what makes it bad.
"""

from __future__ import annotations

import json
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Callable
from multiprocessing import get_context, parent_process
from typing import Any

import numpy as np

from pipelines.serving import Address, StreamSettings
from saga_fg.errors import SagaError

EPOCH = 1.7e9  # s; the good clients' clock starts here
JUMPS = (-EPOCH, -1e8, -1e4, -60.0, -11.0, 11.0, 60.0, 1e4, 1e8, 9e10)  # of a clock, s
SENSORS = ("front", "rear")  # of the good clients
NUMBERS = (1e300, -1e300, 1.7e308, 5e-324, 1e10, 1e9, -1e9, 1e6, 2.0**63)

MOST = StreamSettings().max_detections

Random = np.random.Generator
Values = dict[str, Any]


def hostile_line(rng: Random, now: float) -> bytes:
    """One line without its end; `now`: about what the good clients' clocks show, s."""
    kind = KINDS[rng.choice(len(KINDS), p=WEIGHTS)]
    return kind(rng, now)


def _frame(rng: Random, now: float, **values: Any) -> Values:
    detection = {"x": float(rng.uniform(-300, 300)), "y": float(rng.uniform(-300, 300)), "label": "car"}
    sensor = f"hostile-{rng.integers(20)}"
    return {"timestamp": now, "sensor": sensor, "detections": [detection]} | values


def _line(message: Any) -> bytes:
    return json.dumps(message).encode()


def _clock(rng: Random, now: float) -> bytes:
    """Two frames that agree on another time: the clock is set."""
    there = now + float(rng.choice(JUMPS))
    return _line(_frame(rng, there)) + b"\n" + _line(_frame(rng, there + 0.1))


def _glitch(rng: Random, now: float) -> bytes:
    return _line(_frame(rng, now + float(rng.choice(JUMPS))))


def _numbers(rng: Random, now: float) -> bytes:
    frame = _frame(rng, now)
    names = ["x", "y", "z", "length", "width", "height", "yaw", "vx", "vy", "score"]
    for name in rng.choice(names, rng.integers(1, 4), replace=False).tolist():
        frame["detections"][0][name] = float(rng.choice(NUMBERS))
    return _line(frame)


def _far(rng: Random, now: float) -> bytes:
    """Numbers that pass the door: far away, and fast."""
    frame = _frame(rng, now)
    frame["detections"][0] |= {
        "x": float(rng.uniform(-1e9, 1e9)),
        "vx": float(rng.uniform(-1e6, 1e6)),
        "vy": float(rng.uniform(-1e6, 1e6)),
    }
    return _line(frame)


def _range_rate(rng: Random, now: float) -> bytes:
    frame = _frame(rng, now, coordinates="ego", ego={"x": 0, "y": 0, "yaw": 0}, sensor="hostile-radar")
    frame["detections"][0] |= {"x": 20.0, "y": 5.0, "range_rate": float(rng.choice([1e10, -1e10, 1e300, 1e5, 200.0]))}
    return _line(frame)


def _bits(rng: Random, now: float) -> bytes:
    """Numbers of the whole range of float64."""
    frame = _frame(rng, now)
    (x, y) = struct.unpack("<2d", rng.bytes(16))
    frame["detections"][0] |= {"x": x, "y": y}
    return _line(frame)


def _types(rng: Random, now: float) -> bytes:
    odd: tuple[Any, ...] = (None, True, "1", [], {}, [[1]], {"a": 1}, -1, "x" * 1000)
    name = str(rng.choice(["timestamp", "sensor", "seq", "coordinates", "ego", "detections", "type", "unknown"]))
    return _line(_frame(rng, now, **{name: odd[rng.integers(len(odd))]}))


def _deep(rng: Random, now: float) -> bytes:
    opening = [b"[", b'{"a":', b'{"detections":['][rng.integers(3)]
    return opening * int(rng.integers(1000, 200_000))


def _integer(rng: Random, now: float) -> bytes:
    digits = b"9" * int(rng.integers(20, 6000))
    name = [b"timestamp", b"seq"][rng.integers(2)]
    return b'{"sensor": "hostile-0", "detections": [], "' + name + b'": ' + digits + b"}"


def _constant(rng: Random, now: float) -> bytes:
    return b'{"timestamp": ' + [b"NaN", b"-Infinity", b"1e400", b"-1e400"][rng.integers(4)] + b', "detections": []}'


def _bytes(rng: Random, now: float) -> bytes:
    return rng.bytes(int(rng.integers(1, 400))).replace(b"\n", b" ")


def _damaged(rng: Random, now: float) -> bytes:
    """A valid line with a few bytes changed."""
    line = bytearray(_line(_frame(rng, now)))
    for place in rng.integers(len(line), size=3).tolist():
        line[place] = int(rng.integers(11, 256))
    return bytes(line)


def _long(rng: Random, now: float) -> bytes:
    return b"[" + b"1," * int(rng.integers(2**19, 3 * 2**20))


def _crowd(rng: Random, now: float) -> bytes:
    return _line(_frame(rng, now, detections=[{"x": 0, "y": 0}] * (MOST + 1)))


def _heavy(rng: Random, now: float) -> bytes:
    """A valid frame of as many objects as one may have."""
    detections = [{"x": x, "y": y, "label": "car"} for x, y in rng.uniform(-300, 300, (MOST, 2)).round(2).tolist()]
    return _line(_frame(rng, now, sensor="hostile-heavy", detections=detections))


def _number(rng: Random, now: float) -> bytes:
    """The name of a good client's sensor, with a number that would make all its frames repeats."""
    number = int(rng.choice([2**63 - 1, 2**62, 10**12, 10**8, 2 * 10**6]))
    return _line(_frame(rng, now, sensor=str(rng.choice(SENSORS)), seq=number))


def _wrong_clock(rng: Random, now: float) -> bytes:
    """The name of a good client's sensor, whose clock is steadily an hour ahead."""
    return _line(_frame(rng, now + 3600.0, sensor=str(rng.choice(SENSORS))))


def _wrong_sensor(rng: Random, now: float) -> bytes:
    """A sensor of its own with a steadily wrong, a drifting or a jumping clock, whose frames are valid."""
    second = int(now - EPOCH)
    offset = {
        "ahead": 1.0,
        "behind": -3600.0,
        "drifting": 1e-2 * (now - EPOCH),
        "jumping": float(np.random.default_rng(second).uniform(-10.0, 10.0)),
    }
    name = str(rng.choice(list(offset)))
    return _line(_frame(rng, now + offset[name], sensor=name))


def _names(rng: Random, now: float) -> bytes:
    return _line(_frame(rng, now, sensor=f"hostile-{rng.integers(10**9)}"))


def _request(rng: Random, now: float) -> bytes:
    return _line({"type": str(rng.choice(["status", "reset", "stop", "subscribe", ""], p=[0.7, 0.05, 0.1, 0.05, 0.1]))})


def _valid(rng: Random, now: float) -> bytes:
    return _line(_frame(rng, now + float(rng.uniform(-2, 2))))


WEIGHTED: dict[Callable[[Random, float], bytes], float] = {
    **dict.fromkeys((_numbers, _far, _range_rate, _bits, _types, _damaged, _valid), 3.0),
    **dict.fromkeys((_integer, _constant, _bytes, _names, _request, _glitch, _number), 2.0),
    _wrong_sensor: 4.0,
    **dict.fromkeys((_deep, _clock, _wrong_clock), 0.5),
    **dict.fromkeys((_long, _crowd, _heavy), 0.1),
}
KINDS = tuple(WEIGHTED)
WEIGHTS = np.array(list(WEIGHTED.values())) / sum(WEIGHTED.values())


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

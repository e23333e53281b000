"""A service among hostile clients: which frames of two good clients are lost, doubled or late.

    two good clients   numbered frames of the same objects, each of its own sensor
    hostile clients    broken, poisonous and random messages, connections that break off; sensors whose clocks are
                       wrong, drift or jump
    a listener         that has subscribed and does not read
    the driver         kills the service half-way (SIGKILL) and starts it again from its snapshot

The service has to answer each good frame once, and to take it in (`tracks`): clocks of others are no reason to leave it
out as `late` or `unconfirmed`. A frame is *lost* without such an answer, or if the service has not counted it in
`taken`; it is *doubled* if it was answered as taken in twice, or if the service has counted it twice. Frames answered
after the last snapshot before the kill are answered again, and the new answer counts, because the service has forgotten
the first.
"""

from __future__ import annotations

import socket
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.service.attack import Attack
from benchmarks.service.endurance import CirclingObjects
from benchmarks.service.good_client import JUDGED, GoodClient
from benchmarks.service.hostile_messages import EPOCH, SENSORS
from benchmarks.service.served import Served
from pipelines.serving import Address, StreamClient
from pipelines.serving.messages import encode
from pipelines.tracking import Progress
from saga_fg.errors import SagaError
from saga_fg.settings import Positive, PositiveInt, Settings, setting

VALID = 0.2  # share of the messages that are frames of the good clients
BEAT = 0.01  # s
WARM = 0.1  # share of the run after which memory is first read
MOST_STALL, MOST_GROWTH = 0.5, 1.05  # s; memory at the end by memory at the start
LEAST_TRACKED = 0.99  # share of the valid frames


@dataclass(frozen=True)
class HostileBenchSettings(Settings):
    """Number and rate of messages."""

    messages: PositiveInt = setting(20_000, "messages in all, a fifth of them valid frames of two good clients")
    objects: PositiveInt = setting(50, "objects in each valid frame")
    pace: Positive = setting(50.0, "frames a good client sends in a second")
    seed: int = setting(0, "seed of messages and faults")

    @property
    def frames(self) -> int:
        """Frames that each good client sends."""
        return max(1, round(self.messages * VALID / len(SENSORS)))


@dataclass(frozen=True)
class HostileBench:
    """Counts of messages, times and memory.

    tracked                         frames of the good clients whose answer was `tracks`
    valid, answered, lost, doubled  frames of the good clients
    late, unconfirmed               answered, of these so
    sent_again                      after broken connections
    longest_stall                   from sending a good frame to its answer, outside the restart, s
    machine_stall                   the longest that a thread that only sleeps was kept waiting meanwhile, s
    memory                          after a tenth and at the end, MB
    restarts, failures              of the tracker, and internal errors
    dropped                         clients that were closed, by reason
    first_answer                    from the start of the second service to its first answer to a good client, s
    """

    tracked: int
    valid: int
    answered: int
    lost: int
    doubled: int
    late: int
    unconfirmed: int
    sent_again: int
    hostile: int
    refused: int
    longest_stall: float
    machine_stall: float
    memory: tuple[float, float]
    restarts: int
    failures: int
    dropped: dict[str, int]
    first_answer: float

    @property
    def shortcomings(self) -> list[str]:
        """One text for each figure that is out of bounds."""
        growth, stall = self.memory[1] / self.memory[0], self.longest_stall
        checks = {
            f"{self.lost} frames lost": self.lost > 0,
            f"{self.doubled} frames doubled": self.doubled > 0,
            f"{self.tracked} of {self.valid} frames tracked, expected {100 * LEAST_TRACKED:g} %": (
                self.tracked < LEAST_TRACKED * self.valid
            ),
            f"a stall of {stall:.3f} s, expected at most {MOST_STALL:g} s": stall > MOST_STALL,
            f"memory grew to {growth:.3f} of the start, expected at most {MOST_GROWTH:g}": growth > MOST_GROWTH,
        }
        return [text for text, wrong in checks.items() if wrong]


def bench_hostile_service(settings: HostileBenchSettings, progress: Progress | None = None) -> HostileBench:
    """Run it on this machine. Raises `SagaError` when the service does not come up, or does not come back."""
    with tempfile.TemporaryDirectory() as folder:
        address = Address(path=Path(folder) / "service.sock")
        return _Run(settings, address, Path(folder) / "state", progress).run()


class _Run:
    """One run: its processes and threads, and what they share."""

    def __init__(
        self, settings: HostileBenchSettings, address: Address, state: Path, progress: Progress | None
    ) -> None:
        self._settings = settings
        self._address = address
        self._options = ("--listen", str(address), "--snapshot", str(state), "--every", "0.2")
        self._progress = progress
        self._rng = np.random.default_rng([settings.seed, 5])
        self._pulse = _Pulse()
        self._objects = CirclingObjects(settings.objects, settings.seed)

    def run(self) -> HostileBench:
        settings = self._settings
        server = Served(*self._options)
        hostile = settings.messages - len(SENSORS) * settings.frames
        attack = Attack(self._address, settings.seed, hostile, settings.frames / settings.pace)
        clients = [self._good_client(number) for number in range(len(SENSORS))]
        try:
            with _Background(partial(_listen, self._address)), _Background(self._pulse.run):
                for client in clients:
                    client.start()
                self._wait(clients, attack, WARM)
                early = self._status()
                self._wait(clients, attack, float(self._rng.uniform(0.45, 0.55)))
                killed = time.monotonic()
                server.kill()
                started = time.monotonic()
                server = Served(*self._options)
                self._wait(clients, attack, 1.0)
                hostile = attack.end()
                final = self._status()
            for client in clients:
                if client.error is not None:
                    raise SagaError(f"{client.sensor}: {client.error}") from client.error
            return self._figures(clients, hostile, early, final, killed, started)
        finally:
            attack.kill()
            server.kill()

    def _good_client(self, number: int) -> GoodClient:
        sensor, frames = SENSORS[number], self._settings.frames

        def line(seq: int) -> bytes:
            rng = np.random.default_rng([self._settings.seed, number, seq])
            elapsed = (seq + number / len(SENSORS)) / self._settings.pace
            message = {"seq": seq, "timestamp": round(EPOCH + elapsed, 6), "sensor": sensor}
            return encode(message | {"detections": self._objects.detections(elapsed, rng)})

        dies_at = int(self._rng.integers(frames // 10, max(2, frames // 3))) if number == 0 else -1
        return GoodClient(self._address, sensor, frames, self._settings.pace, line, dies_at)

    def _wait(self, clients: list[GoodClient], attack: Attack, until: float) -> None:
        """Until so much of the run is done, telling the hostile clients how far it is."""
        done, total = 0, len(clients) * self._settings.frames
        while done < until * total and any(client.is_alive() for client in clients):
            time.sleep(0.005)
            done = sum(len(client.waits) for client in clients)
            attack.go_on(done / total)
            if self._progress is not None:
                self._progress("valid frames", done, total)

    def _status(self) -> dict[str, Any]:
        with StreamClient(self._address) as client:
            return client.ask({"type": "status"})

    def _figures(
        self,
        clients: list[GoodClient],
        hostile: int,
        early: dict[str, Any],
        final: dict[str, Any],
        killed: float,
        started: float,
    ) -> HostileBench:
        lost = doubled = 0
        for client in clients:
            missing, again = client.lost_and_doubled(final["taken"].get(client.sensor, 0))
            lost, doubled = lost + missing, doubled + again
        answers = Counter(kind for client in clients for kind in client.answers.values())
        waits = [wait for client in clients for wait in client.waits]
        back = min(answered for _, answered in waits if answered > started)
        stalls = [answered - sent for sent, answered in waits if answered < killed or sent > back]
        return HostileBench(
            valid=sum(client.frames for client in clients),
            answered=sum(answers[kind] for kind in (*JUDGED, "repeat")),
            tracked=answers["tracks"],
            lost=lost,
            doubled=doubled,
            late=answers["late"],
            unconfirmed=answers["unconfirmed"],
            sent_again=sum(client.sent_again for client in clients),
            hostile=hostile,
            refused=final["refused"],
            longest_stall=max(stalls),
            machine_stall=self._pulse.longest,
            memory=(early["memory_mb"], final["memory_mb"]),
            restarts=final["restarts"],
            failures=final["failures"],
            dropped=final["closed"],
            first_answer=back - started,
        )


class _Background:
    """A context in which a thread does `work` until the event says that it is over."""

    def __init__(self, work: Callable[[threading.Event], None]) -> None:
        self._over = threading.Event()
        self._thread = threading.Thread(target=work, args=(self._over,), daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()


class _Pulse:
    """Does nothing but sleep; `longest`: by how much it woke up late at most, s."""

    def __init__(self) -> None:
        self.longest = 0.0

    def run(self, over: threading.Event) -> None:
        while not over.is_set():
            before = time.monotonic()
            time.sleep(BEAT)
            self.longest = max(self.longest, time.monotonic() - before - BEAT)


def _listen(address: Address, over: threading.Event) -> None:
    """Subscribe and do not read; come back when dropped."""
    while not over.wait(0.1):
        try:
            with socket.socket(socket.AF_UNIX) as listener:
                listener.connect(str(address))
                listener.sendall(b'{"type": "subscribe"}\n')
                while not over.wait(0.1) and _open(listener):
                    pass
        except OSError:
            continue


def _open(listener: socket.socket) -> bool:
    """Return whether the service still has this connection: to write into a closed one is an error."""
    listener.send(b"\n")
    return True

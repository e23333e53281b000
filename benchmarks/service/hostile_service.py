"""A service among hostile clients: which frames of two good clients are lost, doubled or late.

    two good clients   numbered frames of the same objects, each of its own sensor, in step, so that on a slow machine
                       none is late
    hostile clients    200 at a time: broken, poisonous and random messages, connections that break off; sensors whose
                       clocks are wrong, drift or jump
    a listener         that has subscribed and does not read
    the driver         starts another service with the same snapshot, lets the disk be full for a tenth of the run,
                       kills the service half-way (SIGKILL) and starts it again from its snapshot

The service has to answer each good frame once, and to take it in (`tracks`): clocks of others are no reason to leave it
out as `late` or `unconfirmed`. A frame is *lost* without such an answer, or if the service has not counted it in
`taken`; it is *doubled* if it was answered as taken in twice, or if the service has counted it twice. Frames answered
after the last snapshot before the kill are answered again, and the new answer counts, because the service has forgotten
the first.
"""

from __future__ import annotations

import socket
import subprocess
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.runner import PROGRAM
from benchmarks.service.attack import Attack
from benchmarks.service.good_client import JUDGED, PATIENCE, GoodClient
from benchmarks.service.hostile_messages import EPOCH, SENSORS
from benchmarks.service.served import CirclingObjects, Served
from pipelines.serving import Address, StreamClient
from pipelines.serving.messages import encode
from pipelines.tracking import Progress
from saga_fg.errors import SagaError

VALID = 0.2  # share of the messages that are frames of the good clients
BEAT, TOLD_WITHIN = 0.01, 5.0  # s
WARM = 0.1  # share of the run after which memory is first read
FULL = (0.25, 0.35)  # shares of the run between which the disk is full
MAX_STALL, MAX_GROWTH = 0.3, 1.05  # s, beyond that of a thread that sleeps; memory at the end by that at the start
MIN_TRACKED = 0.99  # share of the valid frames


def bench_hostile_service(
    messages: int, objects: int, pace: float, seed: int, progress: Progress | None = None
) -> dict[str, Any]:
    """Run it on this machine: counts of messages, times (s) and memory (MB).

    messages  in all, a share `VALID` of them frames of the good clients; objects in each of these; pace: of a good
              client, frames a second

    tracked                         frames of the good clients whose answer was `tracks`
    valid, answered, lost, doubled  frames of the good clients
    late, unconfirmed               answered, of these so
    sent_again                      after broken connections
    longest_stall                   from sending a good frame to its answer, outside the restart
    machine_stall                   the longest that a thread that only sleeps was kept waiting meanwhile
    memory_growth                   at the end, by that after a tenth
    full_disk_told                  in the status, while the disk was full, and no longer afterwards
    second_refused                  another service with the same snapshot, in one line
    restarts, failures              of the tracker, and internal errors
    dropped                         clients that were closed, by reason
    first_answer                    from the start of the second service to its first answer to a good client

    Raises `SagaError` when the service does not come up, or does not come back.
    """
    frames = max(1, round(messages * VALID / len(SENSORS)))
    with tempfile.TemporaryDirectory() as folder:
        run = _Run(Path(folder), frames, pace, CirclingObjects(objects, seed), seed, progress)
        return run.run(messages - len(SENSORS) * frames)


def shortcomings(figures: Mapping[str, Any]) -> list[str]:
    """One text for each figure that is out of bounds."""
    valid, tracked, growth = figures["valid"], figures["tracked"], figures["memory_growth"]
    lost, doubled, stall = figures["lost"], figures["doubled"], figures["longest_stall"] - figures["machine_stall"]
    checks = {
        f"{lost} frames lost": lost > 0,
        f"{doubled} frames doubled": doubled > 0,
        f"{tracked} of {valid} frames tracked, expected {100 * MIN_TRACKED:g} %": tracked < MIN_TRACKED * valid,
        f"a stall of {stall:.3f} s over that of the machine, expected at most {MAX_STALL:g} s": stall > MAX_STALL,
        "a full disk was not told in the status": not figures["full_disk_told"],
        "another service has taken the same snapshot": not figures["second_refused"],
        f"memory grew to {growth:.3f} of the start, expected at most {MAX_GROWTH:g}": growth > MAX_GROWTH,
    }
    return [text for text, wrong in checks.items() if wrong]


class _Run:
    """One run: its processes and threads, and what they share."""

    def __init__(
        self, folder: Path, frames: int, pace: float, objects: CirclingObjects, seed: int, progress: Progress | None
    ) -> None:
        self._frames, self._pace, self._objects, self._seed, self._progress = frames, pace, objects, seed, progress
        self._folder, self._address = folder, Address(path=folder / "service.sock")
        self._options = ("--listen", str(self._address), "--snapshot", str(folder / "state"), "--every", "0.2")
        self._rng = np.random.default_rng([seed, 5])
        self._pulse, self._in_step = _Pulse(), threading.Barrier(len(SENSORS))

    def run(self, hostile: int) -> dict[str, Any]:
        """With so many hostile messages."""
        server = Served(*self._options)
        refused = self._second_is_refused()
        attack = Attack(self._address, self._seed, hostile, self._frames / self._pace)
        clients = [self._good_client(number) for number in range(len(SENSORS))]
        try:
            with _Background(partial(_listen, self._address)), _Background(self._pulse.run):
                for client in clients:
                    client.start()
                self._wait(clients, attack, WARM)
                early = self._status()
                self._wait(clients, attack, FULL[0])
                with server.full_disk():
                    self._wait(clients, attack, FULL[1])
                    told = self._tells(full=True)
                told = self._tells(full=False) and told
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
            figures = self._figures(clients, hostile, early, final, killed, started)
            return figures | {"full_disk_told": told, "second_refused": refused}
        finally:
            attack.kill()
            server.kill()

    def _second_is_refused(self) -> bool:
        """Start another service with the same snapshot; True if it ends with one line that says why."""
        options = ("--listen", str(self._folder / "second.sock"), *self._options[2:])
        try:
            done = subprocess.run(
                [*PROGRAM, "serve", *options], capture_output=True, text=True, timeout=PATIENCE, check=False
            )
        except subprocess.TimeoutExpired:
            return False
        why = "another service keeps its state in this file"
        return done.returncode == 2 and done.stderr.strip().splitlines()[-1].endswith(why)

    def _good_client(self, number: int) -> GoodClient:
        sensor, frames = SENSORS[number], self._frames

        def line(seq: int) -> bytes:
            rng = np.random.default_rng([self._seed, number, seq])
            elapsed = (seq + number / len(SENSORS)) / self._pace
            message = {"seq": seq, "timestamp": round(EPOCH + elapsed, 6), "sensor": sensor}
            return encode(message | {"detections": self._objects.detections(elapsed, rng)})

        dies_at = int(self._rng.integers(frames // 10, max(2, frames // 3))) if number == 0 else -1
        return GoodClient(self._address, sensor, frames, self._pace, line, dies_at, self._in_step)

    def _wait(self, clients: list[GoodClient], attack: Attack, until: float) -> None:
        """Until so much of the run is done, telling the hostile clients how far it is."""
        done, total = 0, len(clients) * self._frames
        while done < until * total and any(client.is_alive() for client in clients):
            time.sleep(0.005)
            done = sum(len(client.waits) for client in clients)
            attack.go_on(done / total if all(client.waits for client in clients) else 0.0)  # their numbers are known
            if self._progress is not None:
                self._progress("valid frames", done, total)

    def _tells(self, full: bool) -> bool:
        """Whether the status says soon that the state could not be written, or no longer says so."""
        end = time.monotonic() + TOLD_WITHIN
        while (self._status()["state"]["error"] is not None) != full:
            if time.monotonic() > end:
                return False
            time.sleep(BEAT)
        return True

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
    ) -> dict[str, Any]:
        lost = doubled = 0
        for client in clients:
            missing, again = client.lost_and_doubled(final["taken"].get(client.sensor, 0))
            lost, doubled = lost + missing, doubled + again
        answers = Counter(kind for client in clients for kind in client.answers.values())
        waits = [wait for client in clients for wait in client.waits]
        back = min(answered for _, answered in waits if answered > started)
        stalls = [answered - sent for sent, answered in waits if answered < killed or sent > back]
        return {
            "valid": sum(client.frames for client in clients),
            "tracked": answers["tracks"],
            "answered": sum(answers[kind] for kind in (*JUDGED, "repeat")),
            "lost": lost,
            "doubled": doubled,
            "late": answers["late"],
            "unconfirmed": answers["unconfirmed"],
            "sent_again": sum(client.sent_again for client in clients),
            "hostile": hostile,
            "refused": final["refused"],
            "longest_stall": max(stalls),
            "machine_stall": self._pulse.longest,
            "memory": final["memory_mb"],
            "memory_growth": final["memory_mb"] / early["memory_mb"],
            "restarts": final["restarts"],
            "failures": final["failures"],
            "dropped": final["closed"],
            "first_answer": back - started,
        }


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

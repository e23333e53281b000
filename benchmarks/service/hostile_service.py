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

A client that numbers its frames and loses none: what it does when the connection breaks, and what it saw.
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
from benchmarks.service.attack import EPOCH, SENSORS, Attack
from benchmarks.service.served import CirclingObjects, Served
from pipelines.serving import Address, StreamClient
from pipelines.serving.messages import encode
from pipelines.tracking import Progress
from saga_fg.errors import SagaError

TAKEN = ("tracks", "late")  # answers that say that a frame was taken in, or left out for good
JUDGED = (*TAKEN, "unconfirmed")  # answers that say what became of a frame
PATIENCE = 60.0  # s to wait for the service to come back


class GoodClient(threading.Thread):
    """Sends frames 0, 1, 2... of one sensor, `pace` a second, and waits for the answer to each.

    line      the message of a frame
    dies_at   at this frame the connection is cut off, with frames on the way and answers unread
    in_step   of all good clients: none sends a frame before the others have the answer to the one before

    After a broken connection it asks for the status, and sends again what was not answered; or, where `last_seq` shows
    that the service has forgotten answered frames, what comes after `durable_seq`.

    answers   by frame, the type of the answer that says what became of it; of several, the last
    taken     by frame, how often it was answered as taken in; what the service has forgotten does not count
    waits     of every frame, when it was first sent and when it was answered, s of the monotonic clock
    """

    def __init__(
        self,
        address: Address,
        sensor: str,
        frames: int,
        pace: float,
        line: Callable[[int], bytes],
        dies_at: int,
        in_step: threading.Barrier,
    ) -> None:
        super().__init__(name=sensor, daemon=True)
        self.sensor, self.frames = sensor, frames
        self.answers: dict[int, str] = {}
        self.taken: Counter[int] = Counter()
        self.waits: list[tuple[float, float]] = []
        self.sent_again = 0
        self.error: Exception | None = None
        self._address, self._pace, self._line, self._dies_at = address, pace, line, dies_at
        self._in_step = in_step
        self._client = StreamClient(address, timeout=PATIENCE)

    def run(self) -> None:
        """Send all frames."""
        try:
            start = time.monotonic()
            for seq in range(self.frames):
                time.sleep(max(0.0, start + seq / self._pace - time.monotonic()))
                self._in_step.wait()
                if seq == self._dies_at:
                    self._die(seq)
                sent = time.monotonic()
                self._deliver(seq)
                self.waits.append((sent, time.monotonic()))
        except threading.BrokenBarrierError:  # another client has failed
            pass
        except Exception as error:  # for the benchmark to raise
            self.error = error
            self._in_step.abort()
        finally:
            self._client.close()

    def lost_and_doubled(self, counted: int) -> tuple[int, int]:
        """Frames that were not judged, and frames that were taken in again; `counted`: by the service, as taken in.

        Both by each frame's own answers, so that one does not make up for the other. An answer that got lost is known
        by a later `repeat`, and the sum of all of these by the service's count.
        """
        twice = sum(times - 1 for times in self.taken.values() if times > 1)
        repeats = sum(kind == "repeat" for kind in self.answers.values())
        expected = self.taken.total() + repeats
        unjudged = sum(self.answers.get(seq) not in (*JUDGED, "repeat") for seq in range(self.frames))
        return unjudged + max(0, expected - counted), twice + max(0, counted - expected)

    def _deliver(self, seq: int) -> None:
        """One frame, whatever it takes."""
        first = seq
        while True:
            try:
                for each in range(first, seq + 1):
                    self._client.send(self._line(each))
                    self._receive(each)
                return
            except (OSError, SagaError):
                first = self._connected_again(seq)
                self.sent_again += seq - first

    def _receive(self, seq: int) -> None:
        """The answer to a frame."""
        while True:
            answer = self._client.receive()
            if answer.get("seq") == seq and answer["type"] != "held":
                break
            if answer["type"] == "error" and "seq" not in answer:
                raise ConnectionError(answer["message"])
        kind = answer["type"]
        self.taken[seq] += kind in TAKEN
        if kind != "repeat" or seq not in self.answers:
            self.answers[seq] = kind

    def _connected_again(self, seq: int) -> int:
        """A new connection; the first frame to send."""
        end = time.monotonic() + PATIENCE
        while True:
            self._client.close()
            try:
                self._client = StreamClient(self._address, timeout=PATIENCE)
                status = self._client.ask({"type": "status"})
                return min(seq, self._first_open(status))
            except (OSError, SagaError, KeyError):
                if time.monotonic() > end:
                    raise
                time.sleep(0.02)

    def _die(self, seq: int) -> None:
        """Disconnect like a killed process: frames on the way, answers unread."""
        for each in range(seq, min(seq + 3, self.frames)):
            self._client.send(self._line(each))
        self._client.close()

    def _first_open(self, status: dict[str, Any]) -> int:
        """The first frame that the service may not have."""
        answered = max(self.answers, default=-1)
        last = status["last_seq"].get(self.sensor, -1)
        if last >= answered:
            return answered + 1
        for seq in [each for each in self.taken if each > last]:
            del self.taken[seq]
        return int(status["durable_seq"].get(self.sensor, -1)) + 1


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

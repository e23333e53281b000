"""A client that numbers its frames and loses none: what it does when the connection breaks, and what it saw."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from pipelines.serving import Address, StreamClient
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

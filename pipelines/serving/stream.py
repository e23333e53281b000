"""One stream of messages into one tracker: what is done with a line, whatever it came through."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from pipelines.process import resident_memory
from pipelines.serving.clock import Clock
from pipelines.serving.latency import Latencies
from pipelines.serving.messages import FrameMessage, about, parse_message, tracks_message
from pipelines.serving.reordering import Reordering
from pipelines.serving.settings import StreamSettings
from pipelines.tracking import OnlineTracker
from saga_fg.errors import InputError

Client = TypeVar("Client")
Answer = dict[str, Any]


@dataclass(frozen=True, eq=False)
class _Held(Generic[Client]):
    message: FrameMessage
    client: Client
    received: float


class StreamTracker(Generic[Client]):
    """Takes lines of any number of clients and says who is to be answered what.

    new_tracker  makes a tracker; called at the start, on a reset, and where the clock has jumped back
    settings     limits of the stream

    A line that cannot be used is answered, counted and otherwise without effect. Frames that carry `seq`, the number of
    the message among those of its sensor, are taken in once: after a lost connection a client sends again what was not
    answered.
    """

    def __init__(self, new_tracker: Callable[[], OnlineTracker], settings: StreamSettings | None = None) -> None:
        self.settings = settings or StreamSettings()
        self.counts: Counter[str] = Counter()
        self.latencies = Latencies()
        self._new_tracker = new_tracker
        self._tracker = new_tracker()
        self._clock = Clock(self.settings.max_jump)
        self._held: Reordering[_Held[Client]] = Reordering(self.settings.reorder, self.settings.max_held)
        self._last_seq: dict[str, int] = {}
        self._started = time.monotonic()

    def handle(self, line: bytes, client: Client, received: float | None = None) -> list[tuple[Client, Answer]]:
        """The answers to one line of a client, and to held frames whose turn has come with it.

        received: when the line was read, by `time.monotonic()`
        """
        if not line.strip():
            return []
        self.counts["messages"] += 1
        try:
            message = parse_message(line, self.settings)
            if message == "status":
                return [(client, self.status())]
            if message == "subscribe":
                return [(client, {"type": "subscribe"})]
            if message == "reset":
                return [*self.reset(), (client, {"type": "reset"})]
            assert isinstance(message, FrameMessage)
            return self._take(_Held(message, client, time.monotonic() if received is None else received))
        except InputError as error:
            return [(client, self.refused(error))]

    def refused(self, error: InputError) -> Answer:
        """Count a message that could not be used, and answer it."""
        self.counts["refused"] += 1
        return {"type": "error", "message": str(error), "number": self.counts["messages"]}

    def reset(self) -> list[tuple[Client, Answer]]:
        """Take in what is held, then begin anew. `seq` goes on."""
        answers = self.flush()
        self._tracker = self._new_tracker()
        self._clock = Clock(self.settings.max_jump)
        return answers

    def flush(self) -> list[tuple[Client, Answer]]:
        """Take in all frames that are held back, at the end of a stream."""
        return [self._step(held) for held in self._held.flush()]

    def status(self) -> Answer:
        """Counts since the start, latencies of frames in ms, memory in MB."""
        milliseconds = {
            f"p{percent:g}": round(1e3 * self.latencies.percentile(percent), 3)
            for percent in (50, 90, 99, 99.9)
            if len(self.latencies)
        }
        return {
            "type": "status",
            "seconds": round(time.monotonic() - self._started, 3),
            **{name: self.counts[name] for name in ("messages", "frames", "late", "repeats", "refused", "jumps")},
            "held": len(self._held),
            "latency_ms": milliseconds,
            "memory_mb": round(resident_memory(), 1),
            "last_seq": dict(self._last_seq),
        }

    def _take(self, held: _Held[Client]) -> list[tuple[Client, Answer]]:
        message = held.message
        timestamp, sensor = message.frame.timestamp, message.frame.sensor
        if message.seq is not None and message.seq <= self._last_seq.get(sensor, -1):
            self.counts["repeats"] += 1
            return [(held.client, {"type": "repeat", **about(message)})]
        newest = self._clock.newest
        verdict = self._clock.judge(timestamp)
        if message.seq is not None:
            if sensor not in self._last_seq and len(self._last_seq) >= self.settings.max_sensors:
                raise InputError(
                    f"sensor: expected at most {self.settings.max_sensors} sensors, {sensor!r} is one more"
                )
            self._last_seq[sensor] = message.seq
        if verdict == "doubtful":
            raise InputError(
                f"timestamp: {timestamp:.3f} s is {timestamp - newest:+.3f} s from the newest frame; left out, unless "
                f"the next one of its kind agrees"
            )
        answers: list[tuple[Client, Answer]] = []
        if verdict != "fits":
            self.counts["jumps"] += 1
            answers += self.flush()
            if verdict == "jumped back":
                self._tracker = self._new_tracker()
        elif timestamp < newest:
            self.counts["late"] += 1
        due = self._held.push(timestamp, held)
        if held not in due:
            answers.append((held.client, {"type": "held", **about(message)}))
        return answers + [self._step(each) for each in due]

    def _step(self, held: _Held[Client]) -> tuple[Client, Answer]:
        try:
            tracks = self._tracker.step(held.message.frame)
        except InputError as error:
            return held.client, self.refused(error) | about(held.message)
        answer = tracks_message(tracks, held.message)
        self.counts["frames"] += 1
        self.latencies.add(time.monotonic() - held.received)
        return held.client, answer
